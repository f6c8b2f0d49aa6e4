"""Test learning curves of parking runs (first parked episode, means, standard errors) against known values."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from carlab.cli.bench_options import BenchOptions
from carlab.cli.bench_parking import _curves, _runs
from carlab.core.errors import ConfigError, DataError
from carlab.core.method_names import with_current_methods
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.experiment.campaign.training_plan import TrainingPlan, plan_as_json, plan_from_json
from carlab.studies.parking import as_json, check_run, draw, read_curve, run_folder, summarised


def figures(episode: int, reward: float, *, parked: bool) -> dict[str, object]:
    return EpisodeFigures(
        episode, reward, reward + 1.0, parked, 0.1 if parked else 0.8, 0.0, 0.0, 97 * (episode - 1), math.nan, math.nan,
        5.0, 55.0, 1000, "COMPLETED",
    ).to_dict()  # fmt: skip


def write_run(runs: Path, method: str, seed: int, rewards: list[float], parked: set[int]) -> Path:
    folder = runs / f"2026-01-01_00000{seed}_{method}-seed{seed}"
    folder.mkdir(parents=True)
    plan = {"method": method, "seed": seed, "updates": 1000, "version": 2}
    (folder / "campaign.json").write_text(json.dumps({"plan": plan}))
    rows = [figures(k, r, parked=k in parked) for k, r in enumerate(rewards, start=1)]
    (folder / "learn.json").write_text(json.dumps({"schema": "carlab.learn/1", "episodes": rows[::-1]}))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    return [
        write_run(tmp_path, "gp-sim-posterior", 0, [10.0, 20.0, 30.0], {2, 3}),
        write_run(tmp_path, "gp-sim-posterior", 1, [14.0, 26.0, 30.0], {3}),
        write_run(tmp_path, "gp-sim-posterior", 2, [12.0, 26.0, 30.0, 99.0], {1, 2, 3, 4}),
        write_run(tmp_path, "fsvgd", 0, [1.0, 2.0, 3.0], set()),
        write_run(tmp_path, "fsvgd", 1, [3.0, 2.0, 1.0], {3}),
    ]


def test_summary_equals_hand_computed_values(runs: list[Path]) -> None:
    sim_fsvgd, authors = summarised([read_curve(r) for r in runs])
    assert (sim_fsvgd.method, sim_fsvgd.seeds, sim_fsvgd.episodes) == ("gp-sim-posterior", 3, 3)
    assert sim_fsvgd.first_parked == (2, 3, 1)
    assert sim_fsvgd.median_first_parked == 2.0
    assert authors.first_parked == (None, 3)
    assert authors.median_first_parked == math.inf
    assert np.allclose(sim_fsvgd.mean_return, [12.0, 24.0, 30.0])
    assert np.allclose(sim_fsvgd.return_standard_error, [2.0 / math.sqrt(3.0), 2.0, 0.0])
    assert sim_fsvgd.parked_at_last == pytest.approx((2 / 3 + 1 / 3 + 1.0) / 3.0)
    assert sim_fsvgd.seconds_an_episode == pytest.approx(60.0)
    assert authors.minutes == pytest.approx(3.0)


def test_a_longer_run_counts_up_to_the_last_episode_of_the_study(runs: list[Path]) -> None:
    options = BenchOptions("parking", methods=("gp-sim-posterior", "fsvgd"), seeds=3, episodes=2, runs=runs[0].parent)
    sim_fsvgd, authors = summarised(_curves(_runs(options), options))
    assert (sim_fsvgd.episodes, authors.episodes) == (2, 2)
    assert sim_fsvgd.first_parked == (2, None, 1)
    assert authors.first_parked == (None, None)
    assert sim_fsvgd.parked_at_last == pytest.approx((1 / 2 + 0.0 + 1.0) / 3.0)


def test_missing_episode_row_does_not_shift_other_episodes(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "gp-sim-posterior", 0, [10.0, 20.0, 30.0], {3})
    content = json.loads((folder / "learn.json").read_text())
    kept_rows = [row for row in content["episodes"] if row["episode"] != 2]
    (folder / "learn.json").write_text(json.dumps({**content, "episodes": kept_rows}))
    other = write_run(tmp_path, "gp-sim-posterior", 1, [14.0, 22.0, 34.0], {3})
    curves = [read_curve(r) for r in (folder, other)]
    (found,) = summarised(curves)
    assert found.episodes == 3
    assert np.allclose(found.mean_return, [12.0, 22.0, 32.0])
    assert math.isnan(found.return_standard_error[1]), "episode 2 has one run, so no standard error"
    # The values 10 and 14 (30 and 34) have the standard deviation sqrt(8); two runs give the error 2.
    assert np.allclose([found.return_standard_error[k] for k in (0, 2)], 2.0)
    draw(curves, tmp_path / "parking.png")


def test_episode_without_any_row_has_no_mean(tmp_path: Path) -> None:
    folders = [write_run(tmp_path, "gp-sim-posterior", seed, [10.0, 20.0, 30.0], {3}) for seed in (0, 1)]
    for folder in folders:
        content = json.loads((folder / "learn.json").read_text())
        kept_rows = [row for row in content["episodes"] if row["episode"] != 2]
        (folder / "learn.json").write_text(json.dumps({**content, "episodes": kept_rows}))
    curves = [read_curve(folder) for folder in folders]
    (found,) = summarised(curves)
    assert found.mean_return[0] == 10.0
    assert found.mean_return[2] == 30.0
    assert math.isnan(found.mean_return[1])
    draw(curves, tmp_path / "parking.png")


def test_result_is_valid_json_and_picture_is_drawn(runs: list[Path], tmp_path: Path) -> None:
    curves = [read_curve(r) for r in runs]
    text = json.dumps(as_json(curves, "carlab bench parking"), allow_nan=False)
    assert json.loads(text)["methods"][1]["median_first_parked"] is None
    draw(curves, tmp_path / "study.png")
    assert (tmp_path / "study.png").read_bytes().startswith(b"\x89PNG")


def test_run_folder_is_found_by_method_and_seed(runs: list[Path], tmp_path: Path) -> None:
    assert run_folder(tmp_path, "gp-sim-posterior", 1) == runs[1]
    assert run_folder(tmp_path, "gp-posterior", 1) is None
    (tmp_path / "2026-01-02_000000_gp-sim-posterior-seed1").mkdir()
    with pytest.raises(DataError, match="remove all but one"):
        run_folder(tmp_path, "gp-sim-posterior", 1)


def test_read_curve_refuses_a_folder_without_figures(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a run of carlab learn"):
        read_curve(tmp_path)


def test_earlier_names_of_methods_are_read_with_their_current_names(caplog: pytest.LogCaptureFixture) -> None:
    plan = TrainingPlan("")
    assert plan_from_json(plan_as_json(plan)) == plan
    assert not caplog.records
    earlier = {k: v for k, v in plan_as_json(plan).items() if k != "version"}
    for old, new in (("sim-fsvgd", "gp-sim-posterior"), ("fsvgd", "gp-posterior"), ("fsvgd-authors", "fsvgd")):
        assert plan_from_json({**earlier, "method": old}).method == new
        assert caplog.records[-1].getMessage() == f"The run's method '{old}' is now called '{new}'."
    renamed = {**plan_as_json(plan), "method": "sim-fsvgd-mended"}
    assert plan_from_json(renamed).method == "sim-fsvgd-corrected"


def test_plan_has_the_kind_of_the_particles() -> None:
    """Plans of earlier programs have networks."""
    plan = TrainingPlan("", particles="simulator")
    content = plan_as_json(plan)
    assert plan_from_json(content) == plan
    assert plan_from_json({k: v for k, v in content.items() if k != "particles"}).particles == "network"
    with pytest.raises(ValueError, match="particles of the plan"):
        plan_from_json({**content, "particles": "other"})


def test_folder_and_options_with_the_former_name_of_a_method_are_found(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "sim-fsvgd-mended", 0, [1.0], set())
    assert run_folder(tmp_path, "sim-fsvgd-corrected", 0) == folder
    given = ["bench", "parking", "--methods", "fsvgd", "sim-fsvgd-mended", "--runs", "fsvgd-mended"]
    expected = ["bench", "parking", "--methods", "fsvgd", "sim-fsvgd-corrected", "--runs", "fsvgd-mended"]
    assert with_current_methods(given) == expected
    assert with_current_methods(["learn", "--method=sim-fsvgd-mended"]) == ["learn", "--method=sim-fsvgd-corrected"]


def test_a_run_of_the_earlier_method_of_that_name_is_refused(tmp_path: Path) -> None:
    folder = write_run(tmp_path, "sim-fsvgd", 0, [1.0], set())
    (folder / "campaign.json").write_text(json.dumps({"plan": {"method": "sim-fsvgd", "seed": 0, "updates": 1000}}))
    assert read_curve(folder).method == "gp-sim-posterior"
    with pytest.raises(ConfigError, match="was started with --methods gp-sim-posterior; use the same option"):
        check_run(folder, {"method": ("--methods", "sim-fsvgd")})
