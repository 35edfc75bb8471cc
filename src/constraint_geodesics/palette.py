"""Colours that colour-blind people tell apart (Okabe and Ito's), and the one that each planner has
everywhere: in the figures, on the report's pages and in Rerun.
"""

BLACK, ORANGE, SKY, GREEN = "#222222", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE, YELLOW = "#0072B2", "#D55E00", "#CC79A7", "#F0E442"
GREY, LIGHT = "#606060", "#E4E4E4"
SERIES = (SKY, ORANGE, PURPLE, BLUE, YELLOW, GREEN, VERMILION)
"""Of things that are counted and have no colour of their own."""
START, GOAL = GREEN, VERMILION
"""A path's ends."""

FAMILIES = (
    (
        ORANGE,
        "this planner, its parts and policies",
        (
            "planner",
            "planned",
            "learned",
            "without",
            "nothing learned",
            "trees + band",
            "band and trees",
            "graph",
            "policy",
            "policies",
            "separate policies",
        ),
    ),
    (
        VERMILION,
        "latent geodesics, graph and grid",
        ("straight latent line", "gradient geodesic", "latent g"),
    ),
    (GREEN, "straight line and elastic band", ("straight", "band from")),
    (BLACK, "trajectory optimisation", ("slsqp", "trust-constr")),
    (BLUE, "BiRRT", ("birrt",)),
    (PURPLE, "PRM", ("prm",)),
    (SKY, "RRT*", ("rrt*", "informed rrt*")),
    (
        GREY,
        "random curves, descent, Bayesian optimisation",
        ("random curves", "descent", "bayesian"),
    ),
)
"""Colour, name and first words of the planners of each family; within a family they differ by line
style or marker.
"""


def planner_family(planner: str) -> int | None:
    """Place in FAMILIES of a planner, given as a table or a recording names it; None for one that
    is in none.
    """
    words = planner.lower().replace("_", " ").replace("rrt star", "rrt*")
    return next((k for k, (_, _, first) in enumerate(FAMILIES) if words.startswith(first)), None)


def planner_colour(planner: str) -> str:
    """The colour of a planner; grey for one that is in no family."""
    family = planner_family(planner)
    return GREY if family is None else FAMILIES[family][0]
