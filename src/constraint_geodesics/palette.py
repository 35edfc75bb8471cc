"""Colours that colour-blind people tell apart (Okabe and Ito's), and the one that each planner has
everywhere: in the figures, on the report's pages and in Rerun.
"""

from typing import NamedTuple

BLACK, ORANGE, SKY, GREEN = "#222222", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, YELLOW = "#0072B2", "#D55E00", "#CC79A7", "#F0E442"
GREY, LIGHT = "#606060", "#E4E4E4"
SERIES = (SKY, ORANGE, PURPLE, BLUE, YELLOW, GREEN, VERMILION)
"""Of things that are counted and have no colour of their own."""
START, GOAL = GREEN, VERMILION
"""A path's ends."""


class Family(NamedTuple):
    """Planners that share a colour: what they are, and the first words of those of their names that
    stand in recordings and in the pipeline's tables; a baseline names its family itself (peers/).
    """

    colour: str
    about: str
    words: tuple[str, ...]


FAMILIES = {
    "planner": Family(
        ORANGE,
        "this planner, its parts and policies",
        (
            *("planner", "planned", "learned", "without", "only", "nothing learned"),
            *("trees + band", "band and trees", "graph", "policy", "policies", "the same search"),
        ),
    ),
    "latent": Family(
        VERMILION,
        "latent geodesics, graph and grid",
        ("straight latent line", "gradient geodesic", "latent g"),
    ),
    "band": Family(GREEN, "straight line and elastic band", ("straight", "band from")),
    "optimisation": Family(
        BLACK,
        "trajectory optimisation, also with a receding horizon",
        ("slsqp", "trust-constr", "receding horizon"),
    ),
    "birrt": Family(BLUE, "BiRRT", ("birrt",)),
    "prm": Family(PURPLE, "PRM", ("prm",)),
    "rrt_star": Family(SKY, "RRT*", ("rrt*", "informed rrt*")),
    "other": Family(
        GREY,
        "random curves, descent, Bayesian optimisation, path diffusion",
        ("random curves", "descent", "bayesian", "path diffusion"),
    ),
}
"""The families by name; within one, planners differ by line style or marker."""


def planner_family(planner: str) -> str | None:
    """The family of a planner, given as a table or a recording names it; None for one of none."""
    words = planner.lower().replace("_", " ").replace("rrt star", "rrt*")
    return next((name for name, own in FAMILIES.items() if words.startswith(own.words)), None)


def planner_colour(planner: str) -> str:
    """The colour of a planner; grey for one that is in no family."""
    family = planner_family(planner)
    return GREY if family is None else FAMILIES[family].colour
