"""Prediction of balls: state, spin and way from measured tracks, and a benchmark against simpler methods."""

from mjx_tt.prediction.flight_fit import Belief, fit_states, fly_on, learn, predict

__all__ = ["Belief", "fit_states", "fly_on", "learn", "predict"]
