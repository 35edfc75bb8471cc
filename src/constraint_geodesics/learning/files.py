"""Names of a saved manifold's files, and the error of one that can't be used."""

WEIGHTS, CARD = "weights.safetensors", "manifold.json"


class ManifoldFileError(ValueError):
    """A saved manifold that is missing, incomplete or altered; the message names the file."""
