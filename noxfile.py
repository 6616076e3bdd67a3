"""Tests of the core on Python 3.11 to 3.13, also with the newest and lowest versions of libraries.

``pip install nox uv``, then ``nox``, or ``nox -s newest-3.13``; Python versions that are not
installed are skipped. The whole suite on another Python:
``make test PYTHON=python3.13 VENV=FOLDER``.
"""

from __future__ import annotations

import nox

nox.options.default_venv_backend = "uv"
nox.options.error_on_missing_interpreters = False

# One thread per library, as in the Makefile.
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "UV_PYTHON_DOWNLOADS": "never"}
PYTHONS = ["3.11", "3.12", "3.13"]


@nox.session(python=PYTHONS)
def core(session: nox.Session) -> None:
    """Run the tests of the core with the versions of ``constraints.txt``."""
    session.install("-c", "constraints.txt", ".", "pytest", "hypothesis", env=THREADS)
    session.run("pytest", "-p", "no:cacheprovider", "tests/core", env=THREADS)


@nox.session(python=PYTHONS)
def newest(session: nox.Session) -> None:
    """Run the tests of the core with the newest versions of its libraries."""
    session.install("--upgrade", ".", "pytest", "hypothesis", env=THREADS)
    session.run("pytest", "-p", "no:cacheprovider", "tests/core", env=THREADS)


@nox.session(python=PYTHONS)
def lowest(session: nox.Session) -> None:
    """Run the tests of the core with the lowest versions that ``pyproject.toml`` allows.

    Where the lowest version has no wheel for this Python, the next one with a wheel is installed.
    """
    session.install(
        "--resolution=lowest-direct",
        "--only-binary=:all:",
        "--no-binary=probmotion",
        ".",
        "pytest>=8.2",
        "hypothesis>=6.100",
        "pyparsing>=3.2,<3.3",  # later versions warn about matplotlib 3.9
        env=THREADS,
    )
    session.run("pytest", "-p", "no:cacheprovider", "tests/core", env=THREADS)
