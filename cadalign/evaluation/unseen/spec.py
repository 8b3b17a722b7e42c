"""Specification of the experiment on unseen objects."""

from __future__ import annotations

from functools import partial

from cadalign.datasets import KeypointNet
from cadalign.evaluation.runs.folder import RunFolder
from cadalign.evaluation.runs.opened import Run
from cadalign.evaluation.runs.work import Plan
from cadalign.evaluation.spec import Spec, on_datasets
from cadalign.evaluation.unseen.experiment import COLUMNS, unseen_benchmark
from cadalign.evaluation.unseen.figures import plots
from cadalign.evaluation.unseen.learned import learn
from cadalign.evaluation.unseen.options import UnseenOptions
from cadalign.evaluation.unseen.summary import GALLERY, HEADLINE, console_table, summarize
from cadalign.evaluation.unseen.tasks import UnseenTask, UnseenTasks

_CHUNK = 8


def plan(options: UnseenOptions, folder: RunFolder) -> Plan[UnseenTask]:
    """Plan a run over a split's objects; the folder gets what is learned from the other split."""
    dataset = KeypointNet(options.root, shapenet_root=options.shapenet)
    tasks = UnseenTasks(dataset, options)
    learned = learn(dataset, tasks.categories, split=options.train, folder=folder)
    config = {
        **options.as_config(),
        "experiment": options.experiment,
        "root": str(options.root.absolute()),
        "annotations": tasks.fingerprint(),
        "learned": learned.fingerprint(),
    }
    benchmark = unseen_benchmark(learned, options, folder if options.meshes else None)
    return Plan(benchmark, tasks, config | benchmark.config, _CHUNK)


def _describe(run: Run) -> str:
    objects = run.count("category", "model_id")
    given = run.config.get("keypoints")
    keypoints = "all keypoints" if given is None else f"{given} random keypoints"
    share = float(run.config.get("outliers") or 0.0)
    outliers = f", {100 * share:g} % of them moved to anywhere" if share else ""
    return (
        f"on {objects:,} objects of {run.dataset} that are no stretched copy of any model, "
        f"{keypoints} with {run.noise_px or 0:g} px of noise{outliers}"
    )


SPEC = Spec(
    options=UnseenOptions,
    plan=plan,
    results=COLUMNS,
    columns=HEADLINE,
    summarize=summarize,
    table=console_table,
    plots=plots,
    title=partial(on_datasets, "unseen objects"),
    describe=_describe,
    metrics=GALLERY,
    about=(
        "Green is the object with the box of its keypoints, red what a method found: the object "
        "warped to the estimated keypoints, and their box."
    ),
    note=(
        "Medians over the objects that did not fail; lengths in diagonals of the object. Up to "
        "scale: the estimate is scaled about the camera centre first, since one image does not "
        "tell an object's size. Within 68 % and 95 %: how often the truth lies in the regions of "
        "these probabilities that a method states; the deviations are right where the two agree."
    ),
)
