"""Experiments: training algorithms against each other under Ray Tune, and what their results show."""

from rllib_maobs.experiment.report import load_curves, plot_curves, summarise
from rllib_maobs.experiment.rows import decayed, fading
from rllib_maobs.experiment.run import Experiment

__all__ = ["Experiment", "decayed", "fading", "load_curves", "plot_curves", "summarise"]
