"""Measured flights under a model: predictions, their derivatives, noise, and each ball's own start and spin."""
