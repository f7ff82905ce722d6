"""Worlds with a hidden difference from the nominal simulation: a second physics, sealed truths, logs.

Nothing here imports the packages under test, so that a mistake shared by generator and diagnosis cannot hide.
"""
