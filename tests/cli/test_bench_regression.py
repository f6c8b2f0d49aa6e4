"""``carlab bench regression``: figures that follow from the definition, files that hold what was printed."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t

from carlab.cli import run
from carlab.core.errors import ConfigError, DataError
from carlab.studies.regression import methods as regression_methods
from carlab.studies.regression.cases import CASES
from carlab.studies.regression.scores import summarised
from carlab.studies.regression.study import run_study
from learning.baselines.ridge import Ridge
from learning.functional_svgd.fsvgd import fit_fsvgd
from learning.posterior.residuals import fit_residuals
from learning.priors.domain_models import draw_parameters


def test_ridge_in_the_study_is_scipys_likelihood_of_the_same_rows():
    (score,) = run_study("car", rows=(50,), seeds=1, methods=("ridge",))
    data = CASES["car"].data(50, 0)
    model = Ridge.fit(data.inputs.double().numpy(), data.outputs.double().numpy())
    mean, truth = model(data.test_inputs.double().numpy()), data.test_outputs.double().numpy()
    left = fit_residuals(torch.from_numpy(model.errors))
    theirs = multivariate_t(np.zeros(6), (left.factor @ left.factor.T).numpy(), df=left.dof)
    assert score.nll == pytest.approx(-theirs.logpdf(truth - mean).mean(), rel=1e-6)
    assert score.rmse == pytest.approx(np.sqrt(((truth - mean) ** 2).sum(axis=1).mean()), rel=1e-6)


def test_true_parameters_leave_the_noise_that_was_added():
    """The simulator that made a case's rows, with its parameters found again, is at the noise of the case."""
    case = CASES["pendulum"]
    data = case.data(50, 1)
    system = draw_parameters(case.truth, 1, torch.Generator().manual_seed(10_001))
    left = (case.truth(data.test_inputs, system)[0] - data.test_outputs).std(dim=0)
    assert torch.allclose(left, torch.tensor(case.noise_std), rtol=0.1)


def test_what_is_printed_is_written(tmp_path, capsys, monkeypatch):
    out = tmp_path / "study.json"
    arguments = ["bench", "regression", "--case", "1d", "--seeds", "2", "--methods", "SysID", "FSVGD", "--steps", "40"]
    monkeypatch.setattr("sys.argv", ["carlab", *arguments, "--out", str(out)])
    assert run([*arguments, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    study = json.loads(out.read_text())
    assert study["schema"] == "carlab.regression/1"
    assert study["command"].startswith("carlab bench regression --case 1d")
    assert [(s["method"], s["seed"]) for s in study["scores"]] == [
        ("SysID", 0),
        ("FSVGD", 0),
        ("SysID", 1),
        ("FSVGD", 1),
    ]
    for row in study["rows"]:
        for name in ("nll", "rmse", "calibration", "seconds"):
            own = [s[name] for s in study["scores"] if s["method"] == row["method"]]
            assert row[name] == pytest.approx(np.mean(own))
            assert row[f"{name}_standard_error"] == pytest.approx(np.std(own, ddof=1) / np.sqrt(2))
        assert f"{row['nll']:.2f}" in printed
    assert out.with_suffix(".png").stat().st_size > 10_000


@pytest.mark.parametrize(("rows", "steps"), [(5, 5000), (400, 8000)])
def test_the_authors_way_is_that_of_their_public_code(monkeypatch, rows, steps):
    """lasgroup/simulation_transfer at 547fa14, run_regression_exp.py and the commands of its sweeps."""
    received = []

    def spy(inputs, outputs, pool, prior, normaliser, settings):
        received.append(settings)
        return fit_fsvgd(inputs, outputs, pool, prior, normaliser, replace(settings, steps=2))

    monkeypatch.setattr(regression_methods, "fit_fsvgd", spy)
    list(run_study("pendulum", rows=(rows,), seeds=1, methods=("Sim-FSVGD",), way="authors"))
    (used,) = received
    assert (used.particles, used.hidden, used.batch, used.measurement_points) == (20, (64, 64, 64), 8, 32)
    assert (used.bandwidth, used.learning_rate, used.weight_decay, used.steps) == (2.0, 1e-3, 1e-3, steps)
    # One optimiser for networks and noise, without a schedule: a noise that learns faster vanishes at five rows.
    assert used.fit_noise
    assert used.noise_rate == 1.0
    assert not used.anneal_rate
    assert np.allclose(used.noise_std, np.array([0.05, 0.05, 0.5]) / np.array([0.158, 0.150, 0.951]))


def test_the_authors_way_in_one_dimension_is_another_for_each_method(monkeypatch):
    """lasgroup/simulation_transfer at 547fa14, 1d_visualization_run_training.py."""
    received = []

    def spy(inputs, outputs, pool, prior, normaliser, settings):
        received.append(settings)
        return fit_fsvgd(inputs, outputs, pool, prior, normaliser, replace(settings, steps=2))

    monkeypatch.setattr(regression_methods, "fit_fsvgd", spy)
    list(run_study("1d", seeds=1, methods=("Sim-FSVGD", "FSVGD"), way="authors"))
    ours, theirs = received
    assert (ours.steps, ours.bandwidth) == (20_000, 1.0)
    assert (theirs.steps, theirs.bandwidth) == (10_000, 0.5)
    assert {(t.batch, t.measurement_points, t.fit_noise) for t in received} == {(4, 8, False)}
    assert all(np.allclose(t.noise_std, 0.05) for t in received)


def test_a_study_is_the_same_again():
    first, second = (list(run_study("1d", seeds=1, methods=("Sim-FSVGD",), steps=30)) for _ in range(2))
    assert (first[0].nll, first[0].rmse) == (second[0].nll, second[0].rmse)
    assert np.isnan(summarised(first)[0].nll_standard_error)


def test_what_cannot_be_studied_is_said(tmp_path):
    with pytest.raises(ConfigError, match="no method 'SVGD'"):
        list(run_study("1d", methods=("SVGD",)))
    with pytest.raises(ConfigError, match="no case '2d'"):
        list(run_study("2d"))
    with pytest.raises(DataError, match="with --data"):
        list(run_study("racecar", rows=(20,), seeds=1, methods=("ridge",)))
    with pytest.raises(DataError, match=r"pendulum_seed0_n5\.npz does not exist"):
        list(run_study("pendulum", rows=(5,), seeds=1, methods=("ridge",), data=tmp_path))
    with pytest.raises(ConfigError, match="Ridge regression needs 3 rows or more"):
        list(run_study("1d", seeds=1, methods=("ridge",)))


@pytest.mark.parametrize("content", [b"rubbish", None])
def test_broken_arrays_are_named(tmp_path, content):
    path = tmp_path / "pendulum_seed0_n5.npz"
    np.savez(path, x=np.zeros((5, 4)))
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"pendulum_seed0_n5\.npz does not hold the arrays x, y, x_test and y_test"):
        list(run_study("pendulum", rows=(5,), seeds=1, methods=("ridge",), data=tmp_path))


def test_data_that_is_missing_is_told_before_anything_is_fitted(tmp_path, monkeypatch):
    monkeypatch.setattr("carlab.studies.regression.study.scored", lambda *a, **k: pytest.fail("fitted"))
    arrays = {name: np.zeros((5, width)) for name, width in (("x", 4), ("y", 3), ("x_test", 4), ("y_test", 3))}
    np.savez(tmp_path / "pendulum_seed0_n5.npz", **arrays)
    with pytest.raises(DataError, match=r"seed1_n5\.npz does not exist.*fewer --seeds"):
        list(run_study("pendulum", rows=(5,), seeds=2, methods=("ridge",), data=tmp_path))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("regression --out none/x.json", "--out none/x.json: there is no folder none; create it first."),
        ("regression --out x.png", "--out x.png: name a file that ends in .json."),
        ("regression --out folder.json", "--out folder.json: name a file that ends in .json."),
        ("speed --case pendulum", "--case has no effect in 'bench speed'; use it with 'bench regression'."),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_measured(tmp_path, monkeypatch, capsys, options, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.json").mkdir()
    monkeypatch.setattr("carlab.studies.regression.study.run_study", lambda *a, **k: pytest.fail("measured"))
    assert run(["bench", *options.split()]) == 2
    printed = capsys.readouterr()
    assert words in " ".join((printed.out + printed.err).split())


@pytest.mark.parametrize(("case", "way", "noted"), [("pendulum", "ours", True), ("pendulum", "authors", False)])
def test_the_pendulum_table_says_that_its_priors_are_unequal(carlab, case, way, noted):
    code, text = carlab(
        "bench", "regression", "--case", case, "--way", way, "--rows", 5, "--seeds", 1, "--methods", "ridge"
    )
    assert code == 0
    assert ("contains the form of the truth" in text) is noted
    assert ("-5.55 / -6.73 / -7.35 / -7.34" in " ".join(text.split())) is noted
