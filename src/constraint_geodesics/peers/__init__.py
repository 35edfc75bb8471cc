"""Baselines: other planners, asked and judged as this project's own is.

A new one is a file here and a line in params.yaml:
1. `peers/<kind>.py` holds a `BaselineSettings` (baseline.py) whose defaults are the strongest
   settings that are known, and whose class variables say what is known of the kind: its family of
   colours, whether chance plays a part, what its search asks, which trained files it needs.  One
   that steps along its paths says in `with_half_step` what is asked after one that failed.
2. Its `make(context)` returns the planner: anything with a `name` and `plan(problem, seed)` that
   answers with a `Solution` (problem.py).  Heavy libraries are imported there, not at the top.
3. The file ends with `BASELINE = <that class>`: this is how registry.py finds it.
4. A line of `benchmark.planners` in params.yaml, `name: {kind: <kind>, queries: 10}`, with settings
   where they differ; `band: true` shortens its paths, `restarts_s: 1.0` asks it again and again.
`geodesics bench --planner <name>` runs it.
"""
