"""The benchmark as a database that Planner Arena opens.

The schema is that of OMPL's documentation, "How to Benchmark Planners", section "The benchmark
database schema": the tables experiments, plannerConfigs, enums, runs and progress.  A constraint
and scene is an experiment.
"""

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

SCHEMA = """
CREATE TABLE experiments (
  id INTEGER PRIMARY KEY AUTOINCREMENT, name VARCHAR(512),
  totaltime REAL, timelimit REAL, memorylimit REAL,
  runcount INTEGER, version VARCHAR(128), hostname VARCHAR(1024), cpuinfo TEXT,
  date DATETIME, seed INTEGER, setup TEXT
);
CREATE TABLE plannerConfigs (
  id INTEGER PRIMARY KEY AUTOINCREMENT, name VARCHAR(512) NOT NULL, settings TEXT
);
CREATE TABLE enums (name VARCHAR(512), value INTEGER, description TEXT, PRIMARY KEY (name, value));
CREATE TABLE runs (
  id INTEGER PRIMARY KEY AUTOINCREMENT, experimentid INTEGER, plannerid INTEGER, time REAL,
  memory REAL, solved BOOLEAN, correct_solution BOOLEAN, solution_length REAL,
  length_over_best_known REAL, constraint_violation REAL,
  query INTEGER, seed INTEGER, status ENUM,
  FOREIGN KEY (experimentid) REFERENCES experiments(id) ON DELETE CASCADE,
  FOREIGN KEY (plannerid) REFERENCES plannerConfigs(id) ON DELETE CASCADE
);
CREATE TABLE progress (
  runid INTEGER, time REAL, PRIMARY KEY (runid, time),
  FOREIGN KEY (runid) REFERENCES runs(id) ON DELETE CASCADE
);
"""


def export_arena(
    rows: pd.DataFrame, file: Path, about: Mapping[str, str], settings: Mapping[str, str]
) -> None:
    """Write the rows of benchmark.csv as an SQLite database, which replaces an older one.

    about: commit, lock file, processor and date, for the experiments' records.  settings: of each
    planner, as text.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    file.unlink(missing_ok=True)
    statuses = list(dict.fromkeys(rows["status"]))
    with closing(sqlite3.connect(file)) as database, database:
        database.executescript(SCHEMA)
        database.executemany(
            "INSERT INTO enums VALUES ('status', ?, ?)",
            [(k, name) for k, name in enumerate(statuses)],
        )
        planners = {
            str(name): _insert(
                database, "plannerConfigs", {"name": name, "settings": settings.get(str(name), "")}
            )
            for name in rows["planner"].unique()
        }
        for (constraint, scene), case in rows.groupby(["constraint", "scene"], sort=False):
            experiment = _experiment(f"{constraint}, {scene}", case, about)
            number = _insert(database, "experiments", experiment)
            for row in case.to_dict("records"):
                own = {"experimentid": number, "plannerid": planners[str(row["planner"])]}
                _insert(database, "runs", own | _run(row, statuses))


def _experiment(name: str, case: pd.DataFrame, about: Mapping[str, str]) -> dict[str, object]:
    return {
        "name": name,
        "totaltime": float(case["time_s"].sum()),
        "timelimit": 0.0,
        "memorylimit": 0.0,
        "runcount": len(case),
        "version": about.get("commit", ""),
        "hostname": "",
        "cpuinfo": about.get("processor", ""),
        "date": about.get("date", ""),
        "seed": 0,
        "setup": f"{case['query'].nunique()} queries; a run is one query and seed",
    }


def _run(row: Mapping[Any, Any], statuses: Sequence[str]) -> dict[str, object]:
    ratio = row["length_rad"] / row["best_known_rad"] if row["valid"] else None
    return {
        "time": row["time_s"],
        "memory": row["peak_memory_mb"],
        "solved": int(row["status"] == "solved"),
        "correct_solution": int(row["valid"]),
        "solution_length": row["length_rad"],
        "length_over_best_known": ratio,
        "constraint_violation": row["max_violation_rad"],
        "query": row["query"],
        "seed": row["seed"],
        "status": statuses.index(row["status"]),
    }


def _insert(database: sqlite3.Connection, table: str, record: Mapping[str, object]) -> int:
    values = [None if isinstance(x, float) and np.isnan(x) else x for x in record.values()]
    places = ", ".join("?" * len(values))
    found = database.execute(f"INSERT INTO {table} ({', '.join(record)}) VALUES ({places})", values)
    assert found.lastrowid is not None
    return found.lastrowid
