"""Balls from pictures: cameras, detection, places, tracks."""
