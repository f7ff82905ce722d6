"""The ball detector's pictures, training and evaluation."""
