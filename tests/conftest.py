"""Settings that have to be in place before JAX starts, for every test."""

from __future__ import annotations

from pathlib import Path

from mjx_tt import platform

# Two host devices, so that splitting over devices is tested everywhere; compiled programs are kept between runs.
platform.configure(devices=2, cache=Path(__file__).parent.parent / ".cache" / "jax")
