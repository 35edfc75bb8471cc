"""The planner as a model of MLflow: `geodesics serve` answers planning requests with it.

MLflow keeps a copy of this file with the model and runs it there, so a model holds no pickled
object; the networks beside it are safetensors, whose checksums are verified.  Not to be imported:
importing it hands a model to MLflow.
"""

import threading
import time
from collections.abc import Hashable, Mapping
from typing import Any

import mlflow
import mlflow.pyfunc
import pandas as pd
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import DEADLINE_EXCEEDED

from constraint_geodesics.constraints.constraint import Constraint, constraint_from_json
from constraint_geodesics.pipeline.threads import stay_on_one_thread
from constraint_geodesics.planner import Planner
from constraint_geodesics.text_files import parse_json
from constraint_geodesics.tracking.serving import WANTED_UNTIL


class ServedPlanner(mlflow.pyfunc.PythonModel):
    """A row is a query: start and goal [rad], and a constraint's name or its axes, tolerance and
    reference as JSON.
    """

    def load_context(self, context: Any) -> None:
        """Load the planner whose files lie with the model."""
        stay_on_one_thread()
        self.planner = Planner.load(context.artifacts["planner"])
        # the server answers on several threads, and there is one world for collisions
        self.free = threading.Lock()

    def predict(
        self, context: Any, model_input: pd.DataFrame, params: dict[str, Any] | None = None
    ) -> Any:
        """One answer a row, a query that has no path among them: status and explanation say why.

        Raises MlflowException when the client has given up.
        """
        return [self.in_turn(row) for row in model_input.to_dict("records")]

    def in_turn(self, row: Mapping[Hashable, Any]) -> dict[str, Any]:
        """When the planner is free: between two rows of a long request others have their turn."""
        with self.free:
            if time.monotonic() > WANTED_UNTIL.get():
                raise MlflowException("nobody waits for the answer", DEADLINE_EXCEEDED)
            return self.answer(row)

    def answer(self, row: Mapping[Hashable, Any]) -> dict[str, Any]:
        """The path's summary with its rows [rad] and their times [s]; a bad query is an answer as
        well.
        """
        try:
            constraint = constraint_of(str(row["constraint"]))
            path = self.planner.plan(row["start"], row["goal"], constraint)
            return {**path.summary(), "joints": path.joints.tolist(), "times": path.times.tolist()}
        except ValueError as error:  # one bad row must not cost the others their answers
            return {"status": "bad_query", "explanation": str(error), "joints": [], "times": []}


_WHOLE = {"axes": None, "tolerance": [0.0] * 6, "reference": None}
"""What is said of a constraint, and what it is where that is not said."""


def constraint_of(text: str) -> str | Constraint:
    """A constraint's name as it is, or {"axes": [...], "tolerance": [...], "reference": …}, held
    where the start has them unless there is a reference.
    """
    if not text.lstrip().startswith("{"):
        return text
    try:
        about = parse_json(text)
        if more := about.keys() - _WHOLE.keys():
            raise ValueError(f"{', '.join(sorted(more))} is not taken over")
        return constraint_from_json(_WHOLE | about)
    except ValueError as error:
        raise ValueError(
            f"{text}: must have axes, and may have a tolerance, six numbers each, and a reference: "
            f"{error}"
        ) from None


mlflow.models.set_model(ServedPlanner())
