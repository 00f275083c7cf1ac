"""The fast tests on every supported Python that is installed: `make matrix`."""

import os

import nox

nox.options.reuse_existing_virtualenvs = True
nox.options.error_on_missing_interpreters = False


def torch() -> list[str]:
    """The pinned torch, and the index that has its CPU build, if one is named as for `make`."""
    index = os.environ.get("TORCH_INDEX")
    with open("requirements.lock", encoding="utf-8") as lines:
        pinned = next(line.strip() for line in lines if line.startswith("torch=="))
    return [pinned, *(["--extra-index-url", index] if index else [])]


@nox.session(python=["3.11", "3.12", "3.13"])
def tests(session: nox.Session) -> None:
    """Install the locks as `make install-dev` does, then the tests; arguments after `--` go to pytest."""
    session.install(*torch())
    for lock in ("requirements.hashes.lock", "requirements-dev.hashes.lock"):
        session.install("--no-deps", "--require-hashes", "-r", lock)
    session.install("--no-deps", "--editable", ".")
    session.run("python", "-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", *session.posargs)
