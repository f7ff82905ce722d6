"""``python -m tests.exam``: the large hidden-effect examination."""

from tests.exam.examination import main

if __name__ == "__main__":
    raise SystemExit(main())
