"""A task that takes its time, which workers of other processes can import."""

from __future__ import annotations

import time


def slow_square(number: int) -> int:
    time.sleep(0.2)
    return number * number
