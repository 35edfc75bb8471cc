"""Episodes among unknown obstacles as Markdown: reports/episodes.md."""

from collections.abc import Mapping
from typing import Any

from constraint_geodesics.report.cells import fixed, markdown_table, origin, share

NOTE = (
    "An arm follows a certified path among one to three spheres and boxes that it does not know, "
    "at least one of them on its path, and sees each when its surface comes within the sensing "
    "radius. Beyond the braking distance: wherever something was seen the arm could still have "
    "stopped without touching it; inside it: it could not. Reached: of the episodes that can be "
    "solved at all, by a plan that knows every obstacle or by either controller. Contacts are "
    "PyBullet's, every 5 mrad of the executed motion. Which obstacles appear beyond the distance "
    "depends on how the arm moves meanwhile, so that the two are sorted by their own motions; "
    "what became of all episodes compares them. Answers are those asked for by a moving arm "
    "that can still stop, and, apart, by one that no stop would save; one is late where it takes "
    "longer than the 60 ms that it is given: the arm then stops on its path. Waited: from the "
    "sight of something that blocks the motion to a path to the goal, 60 ms at least since no "
    "answer begins sooner; an arm that stops plans while it brakes; those that are never on a "
    "path again are counted. Duration: of the episodes in which both reach the goal"
)
BEYOND = (
    *("constraint", "controller", "episodes", "reached", "contacts"),
    *(
        "beyond",
        "contacts there",
        "reached of solvable",
        "share",
        "inside",
        "no contact",
        "contacts while braking",
    ),
    *("joints at contact [rad/s]", "p95", "tool [m/s]", "p95"),
)
TIMES = (
    *("constraint", "controller", "answers in motion", "late", "median [ms]", "p95"),
    *("no stop saves", "late there", "median [ms]", "p95"),
    *(
        "blocked",
        "never on",
        "waited, median [s]",
        "p95",
        "both reach",
        "duration, median [s]",
        "p95",
    ),
)
SENSING = ("sensing radius [m]", "controller", "episodes", "beyond", "inside", "no contact")

Figures = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By controller, and by "all", constraint, or sensing radius."""


def episodes_markdown(found: Figures, run: Mapping[str, str]) -> str:
    """Contacts and goals, times, and what the sensing radius does, a table each.

    run: where the rows are from, of `run_header`.
    """
    constraints = [name for name in next(iter(found.values())) if not name.endswith(" m")]
    radii = [name for name in next(iter(found.values())) if name.endswith(" m")]
    cases = [(name, who, own[name]) for name in constraints for who, own in found.items()]
    near = [(name, who, own[name]) for name in radii for who, own in found.items()]
    return (
        "\n\n".join(
            [
                "# Episodes among obstacles that are not known",
                f"{NOTE}. {origin(run)}.",
                "## Contacts and goals",
                markdown_table([BEYOND, *(_contacts(*case) for case in cases)]),
                "## Times",
                markdown_table([TIMES, *(_times(*case) for case in cases)]),
                "## By the sensing radius",
                markdown_table([SENSING, *(_sensing(*case) for case in near)]),
            ]
        )
        + "\n"
    )


def _contacts(name: str, controller: str, own: Mapping[str, Any]) -> list[str]:
    beyond, inside = own["beyond"], own["inside"]
    solvable = beyond["solvable"]
    reached = beyond["reached"] / solvable if solvable else None
    return [
        *(name, controller, str(own["episodes"]), str(own["reached"]), str(own["contacts"])),
        str(beyond["episodes"]),
        *(str(beyond["contacts"]), f"{beyond['reached']} of {solvable}", share(reached)),
        *(str(inside["episodes"]), str(inside["without_contact"])),
        str(inside["braking_at_contact"]),
        *(fixed(inside[f"joint_speed_rad_s_{which}"]) for which in ("median", "p95")),
        *(fixed(inside[f"tool_speed_m_s_{which}"]) for which in ("median", "p95")),
    ]


def _times(name: str, controller: str, own: Mapping[str, Any]) -> list[str]:
    asked, inside, both = own["answers"], own["inside"], own["both_reach"]
    return [
        *(name, controller, str(asked["moving"]), str(asked["late"])),
        *(fixed(asked[f"ms_{which}"], 1) for which in ("median", "p95")),
        *(str(inside["answers"]), str(inside["late"])),
        *(fixed(inside[f"answer_ms_{which}"], 1) for which in ("median", "p95")),
        *(str(asked["blocked"]), str(asked["never_on"])),
        *(fixed(asked["waited_s_median"]), fixed(asked["waited_s_p95"])),
        *(str(both["episodes"]), fixed(both["duration_s_median"]), fixed(both["duration_s_p95"])),
    ]


def _sensing(name: str, controller: str, own: Mapping[str, Any]) -> list[str]:
    inside = own["inside"]
    return [
        *(name.removesuffix(" m"), controller, str(own["episodes"])),
        *(str(own["beyond"]["episodes"]), str(inside["episodes"]), str(inside["without_contact"])),
    ]
