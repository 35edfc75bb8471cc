"""Learners of joint space side by side: two tables and what they say, from
reports/compare_manifolds.json.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from constraint_geodesics.params import CompareManifoldsParams, Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import fixed, markdown_table, origin, plus_minus, share
from constraint_geodesics.report.results import read_metrics
from constraint_geodesics.studies.manifolds import LEARNERS, UNIFORM

Figures = Mapping[str, Mapping[str, float]]
"""Mean and deviation over seeds, by figure."""

COLUMNS = (
    ("training [s of one core]", "train_cpu_s", 0),
    ("joint error, mean [rad]", "joint_error_mean_rad", 4),
    ("p95", "joint_error_p95_rad", 4),
    ("tool, median [mm]", "tool_error_median_mm", 1),
    ("p95", "tool_error_p95_mm", 1),
    ("turned, median [°]", "orientation_error_median_deg", 2),
    ("p95", "orientation_error_p95_deg", 2),
    ("held-out row to nearest sample [rad]", "coverage_mean_rad", 3),
    ("geodesic / straight line, by the metric", "geodesic_ratio_mean", 3),
    ("decoded", "decoded_ratio_mean", 3),
)
"""Header, figure and decimals."""
SHARES = (("samples within limits and free", "sample_free"), ("geodesics free", "decoded_free"))
OVER_CONSTRAINTS = ("kept_before", "kept_after", "usable_after")


def manifolds_markdown(params: Params, layout: Layout) -> str:
    """The tables, what they say, and what each learner was given, as Markdown."""
    found = read_metrics(layout.root / "reports" / "compare_manifolds.json")
    learners = {name: found["learners"][name] for name in LEARNERS}
    constraints = {name: found["constraints"][name] for name in sorted(found["constraints"])}
    settings = params.compare_manifolds
    said = " ".join(_sentences(learners, constraints))
    return (
        f"# Learners of joint space\n\n{_given(settings, params, found)}\n\n{said}\n\n"
        f"{markdown_table(_learner_rows(learners))}\n\n"
        f"Samples on each constraint: as drawn / projected / projected, within the limits and free "
        f"of collision; then the time of one projection that succeeds.\n\n"
        f"{markdown_table(_constraint_rows(constraints))}\n"
    )


def _given(settings: CompareManifoldsParams, params: Params, found: Mapping[str, Any]) -> str:
    vae, gplvm, gan = params.manifolds[settings.vae], settings.gplvm, settings.gan
    return (
        f"Each learner is trained on the same {found['rows']:,} configurations free of collision, "
        f"with {len(settings.seeds)} seeds (mean ± deviation), and asked about "
        f"{found['held_out']:,} others. The VAE keeps {share(vae.held_out)} of its own back, by "
        f"which its training ends, and its samples have a width that was chosen so that as many "
        f"are free as of the data. It has at most {vae.epochs} epochs in batches of "
        f"{vae.batch_size}; the GPLVM {gplvm.steps:,} steps of {gplvm.batch_size} rows and "
        f"{gplvm.inducing} inducing points; the GAN {gan.steps:,} steps of its generator with "
        f"{gan.critic_steps} of its critic each, of {gan.batch_size} rows. A GAN has no encoder: "
        f"Gauss-Newton looks for the latent point. {settings.samples:,} samples a seed, "
        f"{settings.checked:,} of them checked; {settings.pairs} geodesics. "
        f"{origin(found['machine'])}."
    )


def _sentences(
    learners: Mapping[str, Figures], constraints: Mapping[str, Mapping[str, Figures]]
) -> list[str]:
    """What the tables say, in three sentences."""
    learned = [name for name in learners if name != UNIFORM]
    errors = {name: _mean(learners[name], "joint_error_mean_rad") for name in learned}
    best, worst = min(learned, key=errors.__getitem__), max(learned, key=errors.__getitem__)
    free = {name: _mean(learners[name], "sample_free") for name in learners}
    freest = max(learned, key=free.__getitem__)
    over = {name: _over_constraints(name, constraints) for name in learners}
    ways = {name: _mean(learners[name], "decoded_ratio_mean") for name in learned}
    told = ", ".join(f"{fixed(ratio, 3)} ({name})" for name, ratio in ways.items())
    return [
        f"Configurations that it never saw are reproduced best by the {best}, to "
        f"{fixed(errors[best], 4)} rad in the mean, and worst by the {worst}, to "
        f"{fixed(errors[worst], 4)} rad.",
        f"The {freest} draws the most samples within the limits and free of collision, "
        f"{share(free[freest], 1)} against {share(free[UNIFORM], 1)} of uniform joints; over the "
        f"constraints {share(over[freest][0], 1)} of its samples keep one as drawn and "
        f"{share(over[freest][2], 1)} can be used once projected, of uniform joints "
        f"{share(over[UNIFORM][0], 1)} and {share(over[UNIFORM][2], 1)}.",
        f"Decoded geodesics are {told} times as long as straight joint lines, which no way through "
        f"joint space can be shorter than.",
    ]


def _over_constraints(
    learner: str, constraints: Mapping[str, Mapping[str, Figures]]
) -> tuple[float, ...]:
    """OVER_CONSTRAINTS of a learner's samples, the mean over all constraints."""
    return tuple(
        float(np.mean([_mean(own[learner], figure) for own in constraints.values()]))
        for figure in OVER_CONSTRAINTS
    )


def _learner_rows(learners: Mapping[str, Figures]) -> list[Sequence[str]]:
    header = ["learner", *(name for name, *_ in COLUMNS), *(name for name, _ in SHARES)]
    rows = [
        [
            name,
            *(_cell(own, figure, digits) for _, figure, digits in COLUMNS),
            *(share(_mean(own, figure), 1) for _, figure in SHARES),
        ]
        for name, own in learners.items()
    ]
    return [header, *rows]


def _constraint_rows(constraints: Mapping[str, Mapping[str, Figures]]) -> list[Sequence[str]]:
    rows = [
        [name, *(_kept(own[learner]) for learner in LEARNERS)] for name, own in constraints.items()
    ]
    return [["constraint", *LEARNERS], *rows]


def _kept(own: Figures) -> str:
    shares = " / ".join(share(_mean(own, figure), 1) for figure in OVER_CONSTRAINTS)
    return f"{shares}; {fixed(_mean(own, 'projected_us'), 1)} µs"


def _cell(own: Figures, figure: str, digits: int) -> str:
    values = own[figure]
    return plus_minus(values["mean"], values["deviation"], lambda value: fixed(value, digits))


def _mean(own: Figures, figure: str) -> float:
    return own[figure]["mean"]
