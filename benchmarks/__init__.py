"""How fast this machine trains, and against what: ``mjx-tt bench`` or ``python -m benchmarks.bench``."""
