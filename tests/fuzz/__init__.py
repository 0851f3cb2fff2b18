"""A fuzzer of everything that reads what others wrote; ``python -m tests.fuzz N`` and ``make fuzz N=…``."""
