"""One page of what experiments showed: `python -m rllib_maobs.report RESULTS_DIR [MORE...]`."""
