"""What a plain installation leaves out, and how it is asked for: meshes that are not convex,
recordings, the pipeline, the benchmark's planners.
"""

from importlib.util import find_spec

_MESHES = ("coacd",)
_RECORD = ("rerun", "pyarrow")
_PIPELINE = (
    *("torch", "mlflow", "dvc", "pandas", "pandera", "lightning", "stable_baselines3"),
    *("gymnasium", "sklearn", "joblib", "dask", "distributed", "sqlalchemy", "filelock"),
    *("jinja2", "packaging", "threadpoolctl", *_RECORD),
)
_BENCH = ("ompl", "bayes_opt", "gpytorch", *_MESHES, *_PIPELINE)
EXTRAS = {"meshes": _MESHES, "record": _RECORD, "pipeline": _PIPELINE, "bench": _BENCH}
"""The modules that each extra of pyproject.toml brings."""


class MissingExtraError(ImportError):
    """What was asked for needs packages that are not installed; the message says how they come."""


def require(extra: str) -> None:
    """Raises MissingExtraError, one line, unless everything that an extra brings is installed;
    nothing is imported.
    """
    missing = [module for module in EXTRAS[extra] if find_spec(module) is None]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        install = f'pip install "constraint-geodesics[{extra}]"'
        raise MissingExtraError(f"{missing[0]}{more} is not installed: {install} brings it")
