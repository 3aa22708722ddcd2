"""Crashes, faults, odd input and long runs. `pytest -m faults` runs them in full and prints what was counted."""
