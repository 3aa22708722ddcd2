"""The film at the end of a run: an episode of the best that was trained."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from rllib_maobs.envs import SCENARIOS, Recorder, parallel_env
from rllib_maobs.experiment.report import FILM, LAST, best_trial, embed_film, load_curves
from rllib_maobs.experiment.trial import TrialSpec
from rllib_maobs.play import play
from rllib_maobs.policies import make_policy


def film_best(
    results_dir: Path,
    specs: Sequence[TrialSpec],
    failed: Collection[str] = (),
    last: int = LAST,
    fetch: Callable[[str], None] | None = None,
) -> str:
    """Film an episode of the best trial, as its last checkpoint plays it, and show it in comparison.md.

    Args:
        results_dir: The folder that the experiment wrote to.
        specs: Its trials.
        failed: Names of trials that do not count.
        last: How many evaluations at the end of each trial count.
        fetch: Brings a trial's checkpoints into the folder, by its name, if they are not there.

    Returns:
        A line that says where the film is, or why there is none; a film that fails is no reason to fail.
    """
    (results_dir / FILM).unlink(missing_ok=True)  # That of the run before it was resumed.
    curves = load_curves(results_dir)
    name = best_trial(curves[~curves["trial"].isin(list(failed))], last)
    spec = next((spec for spec in specs if spec.name == name), None)
    if spec is None:
        return "No film: nothing has been evaluated."
    if spec.env.removeprefix("maobs/") not in SCENARIOS:
        return f"No film: {spec.env} is not an environment of this package."
    if fetch:
        fetch(spec.name)
    checkpoint = max((results_dir / spec.name).glob("checkpoint_*"), default=None)
    if checkpoint is None:
        return f"No film: {spec.name}, the best one, has no checkpoint."
    try:
        film(spec, checkpoint, results_dir / FILM)
    except Exception as error:  # Whatever it is, the results are there, and matter more.
        return f"No film: {str(error).partition(chr(10))[0] or type(error).__name__}"
    embed_film(results_dir, spec.name)
    return f"An episode of {spec.name}, the best one: {results_dir / FILM}"


def film(spec: TrialSpec, checkpoint: str | Path, path: Path) -> None:
    """Film an episode as a checkpoint plays it.

    Args:
        spec: The trial whose checkpoint it is, on an environment of this package.
        checkpoint: Folder of the checkpoint.
        path: The film's file.

    Raises:
        ImportError: If a package for pictures is missing.
    """
    recorder = Recorder(path)
    env = parallel_env(spec.env.removeprefix("maobs/"), render_mode="rgb_array", **spec.evaluation_options)
    play(env, make_policy(env.vector, str(checkpoint)), recorder=recorder)
    recorder.close()
