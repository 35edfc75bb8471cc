"""The benchmark as a database that Planner Arena opens.

The schema is that of OMPL's documentation, "How to Benchmark Planners", section "The benchmark
database schema": the tables experiments, plannerConfigs, enums, runs and progress.  A constraint
and scene is an experiment.
"""

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import pandas as pd

from constraint_geodesics.benchmark.statistics import ratio_of
from constraint_geodesics.text_files import written

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
    status, statuses = pd.factorize(rows["status"])
    planner, planners = pd.factorize(rows["planner"])
    cases = rows.groupby(["constraint", "scene"], sort=False)
    tables = {
        "enums": pd.DataFrame(
            {"name": "status", "value": range(len(statuses)), "description": statuses}
        ),
        "plannerConfigs": pd.DataFrame(
            {"name": planners, "settings": [settings.get(name, "") for name in planners]}
        ),
        "experiments": pd.DataFrame(
            [_experiment(", ".join(map(str, names)), case, about) for names, case in cases]
        ),
        "runs": pd.DataFrame(
            {
                "experimentid": 1 + cases.ngroup(),
                "plannerid": 1 + planner,
                "time": rows["time_s"],
                "memory": rows["peak_memory_mb"],
                "solved": rows["status"] == "solved",
                "correct_solution": rows["valid"],
                "solution_length": rows["length_rad"],
                "length_over_best_known": ratio_of(rows),
                "constraint_violation": rows["max_violation_rad"],
                "query": rows["query"],
                "seed": rows["seed"],
                "status": status,
            }
        ).sort_values("experimentid", kind="stable"),
    }
    try:
        with written(file) as part, closing(sqlite3.connect(part)) as database, database:
            database.executescript(SCHEMA)
            for name, table in tables.items():
                table.to_sql(name, database, if_exists="append", index=False)
    except (sqlite3.OperationalError, pd.errors.DatabaseError) as error:
        raise OSError(f"{file}: {' '.join(str(error).split())}") from None


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
