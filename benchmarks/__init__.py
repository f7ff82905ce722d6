"""Speed of training on this machine, beside other engines: ``make bench`` or ``python -m benchmarks.bench``."""
