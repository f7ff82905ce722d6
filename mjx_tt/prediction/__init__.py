"""Prediction of balls: state, spin and way from measured tracks, and a benchmark against simpler methods."""

from mjx_tt.prediction.predict import predict
from mjx_tt.prediction.state_fit import SpinPrior, fit_states

__all__ = ["SpinPrior", "fit_states", "predict"]
