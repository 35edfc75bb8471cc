"""`geodesics demo`: one episode among obstacles that are not known, live in Rerun's viewer."""

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from constraint_geodesics import completion
from constraint_geodesics.cli_planning import Source, loading
from constraint_geodesics.extras import require
from constraint_geodesics.pipeline.stage import WRONG_USAGE, complain

if TYPE_CHECKING:
    from constraint_geodesics.planner import Planner
    from constraint_geodesics.recording.episode_recording import LiveEpisode
    from constraint_geodesics.studies.episodes import Episode, Happening, Report

NUMBER = 1
"""Of the episodes of a seed: seen from the middle sensing radius."""
WRITTEN = Path("demo.rrd")
"""Where there is no display."""


def demo(
    constraint: Annotated[
        str,
        typer.Option(
            help="A name that `geodesics constraints` lists.",
            shell_complete=completion.planned_constraints,
        ),
    ] = "level_cup",
    seed: Annotated[int, typer.Option(help="Another episode for every number.", min=0)] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Write a Rerun recording here, and open no viewer.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show it in a local browser, not in a window.")
    ] = False,
    planner: Source = None,
) -> None:
    """Show an arm that moves among obstacles which it sees only when they are near, live in Rerun's
    viewer: the path is planned anew while the arm moves, or the arm stops.  Without a display the
    recording is written to demo.rrd.  Exit code 2: wrong usage.
    """
    require("record")
    from constraint_geodesics.bundle import BundleError
    from constraint_geodesics.planner import Planner, PlannerError
    from constraint_geodesics.recording.viewer import display
    from constraint_geodesics.scene.urdf import has_pybullet

    try:
        if out is not None and web:
            raise PlannerError("--out opens no viewer: give it without --web")
        if not has_pybullet():
            line = "the demo needs PyBullet, whose distances say what is seen: use Python 3.11"
            raise PlannerError(line)
        with loading():
            loaded = Planner.load(planner)
            episode = _prepared(loaded, constraint, seed)
    except (BundleError, PlannerError) as error:
        raise SystemExit(complain(error, WRONG_USAGE)) from None
    with loaded:
        if out is None and (web or display()):
            _show(loaded, episode, web)
            return
        file = out or WRITTEN
        _write(file, episode, list(_told(episode, _happenings(loaded, episode))))
        why = "" if out else "there is no display for Rerun's window: "
        print(f"{why}recorded in {file}: open it with geodesics replay {file}")


def _prepared(planner: "Planner", constraint: str, seed: int) -> "Episode":
    """The seed's episode, in a scene with the cup where the constraint keeps one upright."""
    from constraint_geodesics.studies import episodes as study

    planner.prepare(constraint)
    study.attach_cup(planner, constraint)
    episode = study.drawn(planner, constraint, NUMBER, seed)
    # what a process does for the first time takes longer
    planner.replan(episode.first, 0.5 * float(episode.first.times[-1]))
    return episode


def _happenings(planner: "Planner", episode: "Episode") -> "Iterator[Happening]":
    from constraint_geodesics.studies.episodes import Replanner, run

    return run(episode, Replanner(planner))


def _told(episode: "Episode", happenings: "Iterable[Happening]") -> "Iterator[Happening]":
    """The same, each told in a line when it is passed on."""
    from constraint_geodesics.studies.episodes import Answered, Seen, report

    first, passed, seen = episode.first, [], list[Seen]()
    count = len(episode.obstacles)
    print(
        f"{first.constraint_name}: a path of {first.times[-1]:.2f} s, {count} unknown "
        f"obstacle{'s' * (count > 1)} on or beside it, seen from {episode.sensing_m:g} m",
        flush=True,
    )
    for one in happenings:
        passed.append(one)
        if isinstance(one, Seen):
            seen.append(one)
        elif isinstance(one, Answered):
            what = [f"{own.obstacle.name} seen at {own.distance_m:.2f} m" for own in seen]
            print(f"{one.asked_s:.2f} s: {', '.join(what) or 'at rest'}: {one.words}", flush=True)
            seen = []
        yield one
    print(_ending(report(episode, passed)), flush=True)


def _ending(report: "Report") -> str:
    contact, over = report.contact, f"{report.duration_s:.2f} s"
    if contact is not None:
        return f"{over}: touched an obstacle, the tool at {contact.tool_speed_m_s:.2f} m/s"
    return f"{over}: {'goal reached' if report.outcome == 'reached' else report.outcome}"


def _write(file: Path, episode: "Episode", happenings: "list[Happening]") -> None:
    from constraint_geodesics.recording.episode_recording import (
        EpisodeRecord,
        Stretch,
        record_episode,
    )
    from constraint_geodesics.studies.episodes import report

    found, first = report(episode, happenings), episode.first
    stretches = [Stretch(begins, path.times, path.joints) for begins, path in found.legs]
    seen = {one.obstacle.name: one.at_s for one in found.seen}
    about = "replan", first.constraint_name, episode.number, first.scene, episode.obstacles
    text = f"**replan**, constraint `{first.constraint_name}`\n\n- {_ending(found)}"
    ended = found.duration_s, text
    record_episode(file, EpisodeRecord(*about, seen, stretches, *ended, kept=first.constraint))


def _show(planner: "Planner", episode: "Episode", web: bool) -> None:
    """As fast as it happens; the viewer stays until it is closed."""
    from constraint_geodesics.recording.episode_recording import LiveEpisode, Stretch
    from constraint_geodesics.recording.viewer import live_viewer

    first = episode.first
    with live_viewer(web=web) as stream:
        stretch = Stretch(0.0, first.times, first.joints)
        view = LiveEpisode(stream, first.scene, episode.obstacles, stretch, first.constraint)
        _stream(view, _told(episode, _happenings(planner, episode)))


def _stream(view: "LiveEpisode", happenings: "Iterable[Happening]") -> None:
    from constraint_geodesics.recording.episode_recording import Stretch
    from constraint_geodesics.studies.episodes import Answered, Moved, Seen

    began, lines = time.perf_counter(), list[str]()
    for one in happenings:
        if isinstance(one, Moved):
            time.sleep(max(one.at_s - (time.perf_counter() - began), 0.0))
            view.moves(one.at_s, one.joints)
        elif isinstance(one, Seen):
            view.sees(one.at_s, one.obstacle)
        elif isinstance(one, Answered):
            lines.append(f"- {one.asked_s:.2f} s: {one.words}")
            view.says("\n".join(lines))
            if one.path is not None and len(one.path.joints):
                view.follows(Stretch(one.begins_s, one.path.times, one.path.joints))
