"""Speed of training on this machine, beside other engines: ``mjx-tt bench`` or ``python -m benchmarks.bench``."""
