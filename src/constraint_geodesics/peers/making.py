"""Planners made from settings: alone, with a band after them, restarted, or asked until sound."""

import time
from collections.abc import Callable, Mapping
from typing import TypeVar

from constraint_geodesics.peers.baseline import BaselineError, BaselineSettings, Context
from constraint_geodesics.peers.wrappers import BandAfter, Remembered, Restarted, UntilSound
from constraint_geodesics.problem import PathPlanner

AGAIN_S = 2.0
"""Time [s] in which a planner that draws at random, and has no limit of its own, is asked again
while its path is not sound.
"""
Settings = TypeVar("Settings", bound=BaselineSettings)


def until_sound(
    make: Callable[[Settings], PathPlanner], settings: Settings, budget_s: float
) -> UntilSound:
    """A planner that is asked again for `budget_s` [s] while its path is not sound, from the second
    attempt on with half its step, where it has one.
    """
    return UntilSound(make(settings), budget_s, halved(make, settings))


def halved(make: Callable[[Settings], PathPlanner], settings: Settings) -> PathPlanner | None:
    """The planner with half its step; None where it has none."""
    own = settings.with_half_step
    return None if own == settings else make(own)


def made_together(
    settings: Mapping[str, BaselineSettings], context: Context, again_s: float = AGAIN_S
) -> tuple[dict[str, PathPlanner], dict[str, float]]:
    """Planners by name, and the seconds that making each one took: one with a band after it
    shortens the very paths of the one without.  Those that draw at random are asked again while
    their path is not sound, for their own limit or `again_s`.  Raises BaselineError if one can't be
    made.
    """
    shared = {own.bare for own in settings.values() if own.band and own.restarts_s is None}
    shared |= {bare.with_half_step for bare in shared}
    remembered: dict[BaselineSettings, PathPlanner] = {}

    def planner_of(own: BaselineSettings) -> PathPlanner:
        bare = own.bare
        if bare in shared and bare not in remembered:
            remembered[bare] = Remembered(bare.make(context))
        inner = remembered.get(bare) or bare.make(context)
        return BandAfter(inner) if own.band else inner

    made: dict[str, PathPlanner] = {}
    took: dict[str, float] = {}
    for name, own in settings.items():
        began = time.perf_counter()
        try:
            if own.restarts_s is not None:
                first_s = own.model_copy(update={"restarts_s": None}).given_s
                second = halved(planner_of, own)
                made[name] = Restarted(planner_of(own), own.restarts_s, second, first_s)
            elif own.random:
                made[name] = until_sound(planner_of, own, own.given_s or again_s)
            else:
                made[name] = planner_of(own)
        except ValueError as error:
            raise BaselineError(f"benchmark.planners.{name}: {error}") from None
        took[name] = time.perf_counter() - began
    return made, took
