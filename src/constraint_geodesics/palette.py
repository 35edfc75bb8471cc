"""Colours that colour-blind people tell apart (Okabe and Ito's), the one that each planner has
everywhere (in the figures, on the report's pages and in Rerun), and those of the pages themselves.
"""

from typing import NamedTuple

BLACK, ORANGE, SKY, GREEN = "#222222", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, YELLOW = "#0072B2", "#D55E00", "#CC79A7", "#F0E442"
GREY, LIGHT = "#606060", "#E4E4E4"
SERIES = (SKY, ORANGE, PURPLE, BLUE, YELLOW, GREEN, VERMILION)
"""Of things that are counted and have no colour of their own."""
START, GOAL = GREEN, VERMILION
"""A path's ends."""
NEUTRAL = 16
"""By so much do the channels of a colour differ at most that is a grey."""


class Ground(NamedTuple):
    """What a page is drawn with.  soft: of words that matter less; card: behind what stands out;
    mark: behind what a link led to; shade: where more is hidden at the right.
    """

    ink: str
    soft: str
    page: str
    card: str
    line: str
    link: str
    mark: str
    shade: str


DAY = Ground(
    *("#1d2327", "#566169", "#ffffff", "#f4f6f7", "#d5dbdf"), *("#005f98", "#fff3d6", "#00000044")
)
NIGHT = Ground(
    *("#e4e8ea", "#a5b1b9", "#14181b", "#1e2428", "#38424a"), *("#7cc4f2", "#3a3116", "#ffffff55")
)
PAPER = Ground(
    *("#000000", "#444444", "#ffffff", "#ffffff", "#999999"), *("#000000", "#ffffff", "#00000000")
)


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
            *("planner", "planned", "learned", "without", "only"),
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


def by_night(colour: str) -> str:
    """A colour on the dark page: greys turned over between its page and its ink, as in the figures
    there; others are what they are.
    """
    channels = _channels(colour)
    if max(channels) - min(channels) > NEUTRAL:
        return colour
    ends = zip(_channels(NIGHT.ink), _channels(NIGHT.page), strict=True)
    turned = (
        round(ink + (page - ink) * value / 255.0)
        for value, (ink, page) in zip(channels, ends, strict=True)
    )
    return "#" + "".join(f"{value:02X}" for value in turned)


def _channels(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5))
