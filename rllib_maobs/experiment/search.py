"""Searches: Optuna proposes the settings of each trial, and ASHA stops those that fall behind."""

import math
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

from ray import tune
from ray.rllib.utils.annotations import override
from ray.tune.schedulers import ASHAScheduler
from ray.tune.search.optuna import OptunaSearch

from rllib_maobs.experiment.report import SCORE, STEPS
from rllib_maobs.experiment.resume import NOT_RESTORED, StateError
from rllib_maobs.experiment.sweep import Interval, Values

# Of three trials that have come as far one goes on, at a ninth and at a third of the env steps.
_REDUCTION = 3


def check_installed() -> None:
    """Raise a ValueError that says what to install if Optuna is missing."""
    if find_spec("optuna") is None:
        raise ValueError('--search optuna needs Optuna: pip install -c constraints.txt -e ".[search]"')


class Space(NamedTuple):
    """What there is to try: by row, the values of each setting that it takes.

    It has no functions in it, since Optuna's state is pickled plainly.
    """

    rows: Mapping[str, Mapping[str, Values]]

    def __call__(self, trial: Any) -> None:
        """Ask Optuna for a row and its settings; what was asked for is the suggestion."""
        row = trial.suggest_categorical("row", list(self.rows))
        for name, values in self.rows[row].items():
            # Rows have ranges of their own in their settings, so what is good for one says nothing of another.
            key = f"{row}/{name}"
            if not isinstance(values, Interval):
                trial.suggest_categorical(key, values)
            elif isinstance(values.low, int) and isinstance(values.high, int):
                trial.suggest_int(key, values.low, values.high, log=values.logarithmic)
            else:
                trial.suggest_float(key, values.low, values.high, log=values.logarithmic)


class Search(OptunaSearch):
    """Optuna's proposals as settings of trials.

    Args:
        space: What there is to try.
        make_config: From the number of a trial, its row and the settings proposed to the trial's config.
        seed: Of the proposals.
        resumed: Whether a run is resumed. Should Tune fail to, it would start the search once more; not with this.
    """

    def __init__(
        self,
        space: Space,
        make_config: Callable[[int, str, dict[str, Any]], dict[str, Any]],
        seed: int,
        *,
        resumed: bool = False,
    ) -> None:
        optuna = import_module("optuna")  # optional
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        super().__init__(space=space, metric=SCORE, mode="max", seed=seed)
        self._make_config = make_config
        # None: there is nothing to restore.
        self.restored = False if resumed else None

    @override(OptunaSearch)
    def suggest(self, trial_id: str) -> dict[str, Any]:
        """Return the config of the next trial."""
        if self.restored is False:
            raise StateError(NOT_RESTORED)
        suggested = super().suggest(trial_id)
        row = suggested["row"]
        return self._make_config(len(self._ot_trials), row, suggested.get(row, {}))

    @override(OptunaSearch)
    def restore(self, checkpoint_path: str) -> None:
        """Take Optuna's state again."""
        super().restore(checkpoint_path)
        self.restored = True

    @override(OptunaSearch)
    def save(self, checkpoint_path: str) -> None:
        """Save Optuna's state; how configs are made is the program's, not the state's."""
        make_config = self.__dict__.pop("_make_config")
        try:
            super().save(checkpoint_path)
        finally:
            self._make_config = make_config


def stopping(env_steps: int) -> tune.schedulers.TrialScheduler:
    """Return the scheduler that stops trials which score less than two thirds of those that have come as far.

    Args:
        env_steps: Of a whole trial.
    """
    return ASHAScheduler(
        time_attr=STEPS,
        metric=SCORE,
        mode="max",
        max_t=env_steps,
        grace_period=math.ceil(env_steps / _REDUCTION**2),
        reduction_factor=_REDUCTION,
    )
