"""Options of ``carlab bench`` without effect in a study are refused; the others are accepted."""

from __future__ import annotations

import re
import shlex
from dataclasses import fields
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import tyro

from carlab.cli import _verbs, run
from carlab.cli.bench import Bench
from carlab.cli.bench_options import EVERYWHERE, STUDIES_OF_OPTION, check_options
from carlab.core.errors import ConfigError

README = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
GIVEN = {
    "seconds": 1.0, "case": "car", "rows": (5,), "seeds": 1, "methods": ("ridge",), "structure": True,
    "data": Path("folder"), "car": Path("mine.toml"), "history": 0, "diagnosed": Path("model.toml"), "pair": 2,
    "recorded_s": (40.0, 20.0), "runs": Path("others"), "episodes": 3, "updates": 50, "steps": 70,
    "first_seed": 4, "jobs": 2, "ray": "local",
}  # fmt: skip
REPEATED = {"seeds", "first_seed", "jobs", "ray"}
ACCEPTED = {
    ("speed", ()): {"seconds"},
    ("regression", ()): {"case", "rows", *REPEATED, "methods", "data", "steps"},
    ("regression", (("case", "pendulum"),)): {"case", "rows", *REPEATED, "methods", "structure", "data", "steps"},
    ("regression", (("case", "realcar"),)): {
        "case", "rows", *REPEATED, "methods", "data", "steps", "car", "history",
    },
    ("priors", ()): {"rows", *REPEATED, "data", "history", "diagnosed", "pair", "recorded_s", "steps"},
    ("priors", (("data", Path("folder")),)): {"rows", *REPEATED, "data", "car", "history", "diagnosed", "steps"},
    ("parking", ()): {*REPEATED, "methods", "runs", "episodes", "updates", "steps"},
}  # fmt: skip


def test_every_option_is_assigned_to_studies() -> None:
    names = {option.name for option in fields(Bench)}
    assert names == EVERYWHERE | set(STUDIES_OF_OPTION)
    assert not EVERYWHERE & set(STUDIES_OF_OPTION)
    defaults = Bench()
    for name, value in GIVEN.items():
        assert value != getattr(defaults, name), name


@pytest.mark.parametrize(("study", "other_options"), ACCEPTED)
@pytest.mark.parametrize("name", GIVEN)
def test_option_is_accepted_or_refused_as_listed(
    study: str, other_options: tuple[tuple[str, object], ...], name: str
) -> None:
    command = Bench(study, **({name: GIVEN[name]} | dict(other_options)))  # type: ignore[arg-type]
    if name in ACCEPTED[study, other_options]:
        check_options(command)
    else:
        option = f"--{name.replace('_', '-')} has no effect in 'bench {study}"
        with pytest.raises(ConfigError, match=rf"^{option}.*'; use it with 'bench .*'.*\.$"):
            check_options(command)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("speed --case pendulum", "--case has no effect in 'bench speed'; use it with 'bench regression'."),
        ("speed --runs elsewhere", "--runs has no effect in 'bench speed'; use it with 'bench parking'."),
        ("priors --methods ridge", "'bench priors'; use it with 'bench regression' and 'bench parking'."),
        (
            "regression --car mine.toml",
            "--car has no effect in 'bench regression --case 1d'; use it with 'bench regression --case realcar' and "
            "'bench priors --data FOLDER' and 'bench realcars' and 'bench rollouts'.",
        ),
        ("speed --held-out b", "--held-out has no effect in 'bench speed'; use it with 'bench realcars'."),
        (
            "priors --data here --recorded-s 40 20",
            "--recorded-s has no effect in 'bench priors --data here'; use it with 'bench priors' without --data.",
        ),
        (
            "parking --structure",
            "--structure has no effect in 'bench parking'; use it with 'bench regression --case pendulum'.",
        ),
    ],
)
def test_refusal_names_the_studies_in_which_the_option_has_an_effect(
    options: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["bench", *options.split()]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "command",
    [found[0] or found[1] for found in re.findall(r"^\$ (carlab bench .*)$|`(carlab bench [^`]*)`", README, re.M)],
)
def test_commands_of_the_readme_are_accepted(command: str) -> None:
    parsed = tyro.extras.subcommand_cli_from_dict(_verbs(), args=shlex.split(command)[1:], prog="carlab")
    assert isinstance(parsed, Bench)
    check_options(parsed)


def test_bench_without_a_study_lists_the_studies_and_runs_none(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("carlab.studies.speed.measure_speed", lambda **options: pytest.fail("a study ran"))
    assert run(["bench"]) == 2
    _, *lines = capsys.readouterr().err.splitlines()
    studies = [re.match(r"  carlab bench (\w+): \w", line) for line in lines]
    offered, _ = get_args(get_type_hints(Bench)["what"])
    assert tuple(study and study[1] for study in studies) == get_args(offered)


def test_all_rows_are_refused_in_studies_of_few_rows() -> None:
    check_options(Bench("rollouts", rows=(200, "all")))
    with pytest.raises(ConfigError, match="--rows all has no effect in 'bench priors'; use it with 'bench rollouts'"):
        check_options(Bench("priors", rows=(200, "all")))
