"""How the functions under `@njit` are compiled."""

COMPILE = {
    "cache": True,
    "fastmath": {"contract"},
    "error_model": "numpy",
    "nogil": True,
    "_nrt": True,  # said, since it is the caller's otherwise
}
"""Those that allocate arrays, or call what returns one."""
LEAF = COMPILE | {"_nrt": False}
"""All others: numba counts no references to the arrays that they are given, which in a short
function takes longer than its arithmetic.  Numba refuses one that allocates; one that calls what
returns an array would lose its memory (tests/installation/test_kernels.py).
"""
