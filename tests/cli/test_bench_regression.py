"""``carlab bench regression``: scores that follow from their definition, and files that equal the printed table."""

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
from learning.functional_svgd.score_estimators import NuMethod, SpectralStein, kernel_density
from learning.posterior.residuals import fit_residuals
from learning.priors.domain_models import draw_parameters


def test_ridge_scores_equal_those_computed_with_scipy():
    (score,) = run_study("car", rows=(50,), seeds=1, methods=("ridge",))
    data = CASES["car"].data(50, 0)
    model = Ridge.fit(data.inputs.double().numpy(), data.outputs.double().numpy())
    mean, truth = model(data.test_inputs.double().numpy()), data.test_outputs.double().numpy()
    residuals = fit_residuals(torch.from_numpy(model.errors))
    density = multivariate_t(np.zeros(6), (residuals.factor @ residuals.factor.T).numpy(), df=residuals.dof)
    assert score.nll == pytest.approx(-density.logpdf(truth - mean).mean(), rel=1e-6)
    assert score.rmse == pytest.approx(np.sqrt(((truth - mean) ** 2).sum(axis=1).mean()), rel=1e-6)


def test_residuals_of_the_true_simulator_have_the_noise_of_the_case():
    """The simulator that made the rows, with its true parameters, leaves only the noise."""
    case = CASES["pendulum"]
    data = case.data(50, 1)
    system = draw_parameters(case.truth, 1, torch.Generator().manual_seed(10_001))
    residual_std = (case.truth(data.test_inputs, system)[0] - data.test_outputs).std(dim=0)
    assert torch.allclose(residual_std, torch.tensor(case.noise_std), rtol=0.1)


@pytest.fixture
def fits(monkeypatch):
    """The prior and the settings of each fit by fSVGD, which makes two steps only."""
    received = []

    def spy(inputs, outputs, pool, prior, normaliser, settings):
        received.append((prior, settings))
        return fit_fsvgd(inputs, outputs, pool, prior, normaliser, replace(settings, steps=2))

    monkeypatch.setattr(regression_methods, "fit_fsvgd", spy)
    return received


@pytest.mark.usefixtures("short_identification")
def test_printed_scores_are_written_to_the_file(tmp_path, capsys, monkeypatch):
    out = tmp_path / "study.json"
    arguments = f"bench regression --case 1d --seeds 2 --methods SysID gp-posterior --steps 40 --out {out}".split()
    monkeypatch.setattr("sys.argv", ["carlab", *arguments])
    assert run(arguments) == 0
    printed = capsys.readouterr().out
    study = json.loads(out.read_text())
    assert study["schema"] == "carlab.regression/1"
    assert study["command"].startswith("carlab bench regression --case 1d")
    assert [(s["method"], s["seed"]) for s in study["scores"]] == [
        ("SysID", 0),
        ("gp-posterior", 0),
        ("SysID", 1),
        ("gp-posterior", 1),
    ]
    for row in study["rows"]:
        for name in ("nll", "rmse", "calibration", "seconds"):
            values = [s[name] for s in study["scores"] if s["method"] == row["method"]]
            assert row[name] == pytest.approx(np.mean(values))
            assert row[f"{name}_standard_error"] == pytest.approx(np.std(values, ddof=1) / np.sqrt(2))
        assert f"{row['nll']:.2f}" in printed
    assert out.with_suffix(".png").stat().st_size > 10_000


@pytest.mark.parametrize(("rows", "steps"), [(5, 5000), (400, 8000)])
def test_authors_settings_are_those_of_their_public_code(fits, rows, steps):
    """lasgroup/simulation_transfer at 547fa14, run_regression_exp.py and the commands of its sweeps."""
    list(run_study("pendulum", rows=(rows,), seeds=1, methods=("sim-fsvgd",)))
    ((_, used),) = fits
    assert (used.particles, used.hidden, used.batch, used.measurement_points) == (20, (64, 64, 64), 8, 32)
    assert (used.bandwidth, used.learning_rate, used.weight_decay, used.steps) == (2.0, 1e-3, 1e-3, steps)
    # One optimiser for networks and noise, without a schedule; a faster rate of the noise collapses it with five rows.
    assert used.fit_noise
    assert used.noise_rate == 1.0
    assert not used.anneal_rate
    assert np.allclose(used.noise_std, np.array([0.05, 0.05, 0.5]) / np.array([0.158, 0.150, 0.951]))


def test_authors_settings_of_the_1d_case_differ_between_the_methods(fits):
    """lasgroup/simulation_transfer at 547fa14, 1d_visualization_run_training.py."""
    list(run_study("1d", seeds=1, methods=("sim-fsvgd", "fsvgd")))
    sim_fsvgd, fsvgd = (settings for _, settings in fits)
    assert (sim_fsvgd.steps, sim_fsvgd.bandwidth) == (20_000, 1.0)
    assert (fsvgd.steps, fsvgd.bandwidth) == (10_000, 0.5)
    assert {(t.batch, t.measurement_points, t.fit_noise) for _, t in fits} == {(4, 8, False)}
    assert all(np.allclose(t.noise_std, 0.05) for _, t in fits)


def test_study_is_reproducible():
    first, second = (list(run_study("1d", seeds=1, methods=("gp-sim-posterior",), steps=30)) for _ in range(2))
    assert (first[0].nll, first[0].rmse) == (second[0].nll, second[0].rmse)
    assert np.isnan(summarised(first)[0].nll_standard_error)


def test_unknown_method_unknown_case_and_missing_data_are_reported(tmp_path):
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
def test_damaged_data_file_is_named(tmp_path, content):
    path = tmp_path / "pendulum_seed0_n5.npz"
    np.savez(path, x=np.zeros((5, 4)))
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"pendulum_seed0_n5\.npz does not contain the arrays x, y, x_test and y_test"):
        list(run_study("pendulum", rows=(5,), seeds=1, methods=("ridge",), data=tmp_path))


def test_missing_data_is_reported_before_the_first_fit(tmp_path, monkeypatch):
    monkeypatch.setattr("carlab.studies.regression.study.scored", lambda *a, **k: pytest.fail("fitted"))
    arrays = {name: np.zeros((5, width)) for name, width in (("x", 4), ("y", 3), ("x_test", 4), ("y_test", 3))}
    np.savez(tmp_path / "pendulum_seed0_n5.npz", **arrays)
    with pytest.raises(DataError, match=r"seed1_n5\.npz does not exist.*fewer --seeds"):
        list(run_study("pendulum", rows=(5,), seeds=2, methods=("ridge",), data=tmp_path))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("regression --out none/x.json", "--out none/x.json: there is no folder none; create it first."),
        ("regression --out x.png", "--out x.png: name a file that ends in .json."),
        ("regression --out folder.json", "--out folder.json: name a file that ends in .json."),
    ],
)
def test_invalid_options_are_refused_before_the_study(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.json").mkdir()
    monkeypatch.setattr("carlab.cli.bench_regression.run_study", lambda *a, **k: pytest.fail("measured"))
    assert run(["bench", *options.split()]) == 2
    printed = capsys.readouterr()
    assert message in " ".join((printed.out + printed.err).split())


def test_structure_is_given_to_every_method(monkeypatch):
    seen = []
    monkeypatch.setattr("carlab.studies.regression.study.scored", lambda case, *a, **k: seen.append((a[3], case.prior)))
    list(run_study("pendulum_detent", rows=(5,), seeds=1, structure=True))
    assert {name for name, _ in seen} == set(regression_methods.METHODS)
    assert {prior for _, prior in seen} == {CASES["pendulum"].prior_with_structure}
    with pytest.raises(ConfigError, match="no structured simulator"):
        list(run_study("1d", structure=True))


@pytest.mark.parametrize(
    ("name", "acceleration"),
    [
        ("detent", lambda angle, rate, torque, inertia: 4.0 * np.sin(3.0 * angle)),
        ("saturation", lambda angle, rate, torque, inertia: (np.tanh(torque) - torque) / inertia),
        ("friction", lambda angle, rate, torque, inertia: -(1.0 + np.cos(angle)) * rate / inertia),
    ],
)
def test_hidden_effect_changes_the_rate_as_its_equation(name, acceleration):
    """Over a very short step the effect adds its acceleration times the step to the rate."""
    truth, step_s = CASES[f"pendulum_{name}"].truth, 1e-3
    generator = torch.Generator().manual_seed(0)
    inputs, system = truth.inputs(50, generator).double(), draw_parameters(truth, 1, generator).double()
    with_effect = replace(truth, period_s=step_s, substeps=1)(inputs, system)[0, :, 2]
    without = replace(truth, period_s=step_s, substeps=1, hidden_acceleration=None)(inputs, system)[0, :, 2]
    angle = np.arctan2(inputs[:, 0].numpy(), inputs[:, 1].numpy())
    mass, length = system[0, :2].tolist()
    expected = step_s * acceleration(angle, inputs[:, 2].numpy(), inputs[:, 3].numpy(), mass * length**2)
    assert np.allclose((with_effect - without).numpy(), expected, atol=1e-9)


def test_published_errors_weaken_repulsion_and_the_prior_of_fsvgd(fits):
    """Authors' bnn_fsvgd.py: only the driving term is summed; the Gaussian process has weight 1 / (L (batch + k))."""
    names = ("sim-fsvgd", "sim-fsvgd-corrected", "fsvgd", "fsvgd-corrected")
    list(run_study("pendulum", rows=(20,), seeds=1, methods=names))
    assert [(s.repulsion, s.prior_exponent) for _, s in fits] == [
        (0.05, 1.0), (1.0, 1.0), (0.05, 1.0 / (20 * (8 + 32))), (1.0, 1.0),
    ]  # fmt: skip


def test_variants_change_only_the_prior_of_sim_fsvgd(fits):
    names = ("sim-fsvgd", *regression_methods.VARIANTS)
    scores = list(run_study("pendulum", rows=(5,), seeds=1, methods=names))
    assert [score.method for score in scores if score.failed is None] == list(names)
    (published, settings), *variants = fits
    assert all(used == settings for _, used in variants)
    *estimated, (exact, _) = variants
    expected = [kernel_density, SpectralStein(from_normal=True), NuMethod(from_normal=True)]
    assert [prior.estimator for prior, _ in estimated] == expected
    for prior in (exact, *(prior.prior for prior, _ in estimated)):
        assert torch.equal(prior.draws, published.draws)
    assert [prior.prior.discrepancy for prior, _ in estimated] == [published.discrepancy] * 3
    assert exact.discrepancy is None


@pytest.mark.usefixtures("short_identification")
def test_grey_box_improves_on_the_simulator_with_missing_friction():
    sysid, grey_box = run_study("pendulum", rows=(20,), seeds=1, methods=("SysID", "GreyBox"), steps=300)
    assert grey_box.nll < sysid.nll - 0.5
