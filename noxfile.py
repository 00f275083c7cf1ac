"""The fast tests on every supported Python that is installed: `make matrix`."""

import nox

nox.options.reuse_existing_virtualenvs = True
nox.options.error_on_missing_interpreters = False


def locked(name: str) -> list[str]:
    """Requirements of a lock file."""
    with open(name, encoding="utf-8") as lines:
        return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


@nox.session(python=["3.11", "3.12", "3.13"])
def tests(session: nox.Session) -> None:
    """Install the locks, then the tests; arguments after `--` go to pytest."""
    session.install(*[line for line in locked("requirements.lock") if line.startswith("torch==")])
    session.install("-r", "requirements.lock", "-r", "requirements-dev.lock")
    session.install("--no-deps", "--editable", ".")
    session.run("python", "-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", *session.posargs)
