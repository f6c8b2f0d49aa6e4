"""Prediction errors of a simulator on a recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.api.cars import load_car
from carlab.api.loaded_recordings import LoadedRecordings, RecordingLike, as_list, load_recordings
from carlab.api.runs import html_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from carlab.cars import CarFile
    from carlab.diagnosis.events import EventUse
    from carlab.diagnosis.findings import FitErrors, QuantityChange
    from carlab.diagnosis.score_recording import RecordingScore
    from carlab.prediction.errors import ChannelError

ERROR_COLUMNS = ("position_m", "yaw_rad", "vx", "vy", "yaw_rate", "score")


@dataclass(frozen=True)
class PredictionErrors:
    """Errors after a horizon, by the same windows and initial states as the held-out errors of a diagnosis.

    Attributes:
        recordings: the recordings as they were read, with their repairs.
        score: windows, errors (S, 6) of each model, and predicted trajectories.
        is_adaptation_noise_known: whether the car file states the noise of the adaptation.
    """

    recordings: LoadedRecordings
    score: RecordingScore
    is_adaptation_noise_known: bool = False

    @property
    def horizon_s(self) -> float:
        """Prediction horizon [s], an integer number of control periods."""
        return self.score.horizon_s

    @property
    def summary(self) -> dict[str, FitErrors]:
        """Root mean square errors in the whole recording of model, constant velocity, no change, and noise floor."""
        return self.score.whole.summaries()

    @property
    def events(self) -> EventUse:
        """Events of the recordings (collisions, a hand), left out of the errors without ``keep_events``."""
        return self.score.events

    @property
    def summary_with_events(self) -> dict[str, FitErrors]:
        """The errors in the whole recording, including the windows with events."""
        return self.score.whole.summaries(with_events=True)

    @property
    def last_part(self) -> dict[str, FitErrors]:
        """The same for the last part, which a diagnosis of this recording alone holds out; empty if it is too short."""
        return {} if self.score.last is None else self.score.last.summaries()

    def channels(self, model: str = "model") -> tuple[ChannelError, ...]:
        """Rms, median, 90th percentile and bias of each state channel in the whole recording.

        Args:
            model: ``model``, ``adapted``, ``constant velocity`` or ``no change``.
        """
        from carlab.prediction.errors import channel_errors

        return channel_errors(self.score.whole.errors[model])

    @property
    def changes(self) -> tuple[QuantityChange, ...]:
        """Estimated change of the car over the recording; empty without adaptation."""
        from carlab.diagnosis.drift import changes_along

        adaptation = self.score.adaptation
        return () if adaptation is None else changes_along(adaptation.series())

    def table(self) -> list[dict[str, Any]]:
        """One dict for each model: position_m [m], yaw_rad [rad], vx, vy [m/s], yaw_rate [rad/s], score."""
        return [{"model": name, **asdict(errors)} for name, errors in self.summary.items()]

    def plot(self) -> Figure:
        """Draw recorded and predicted paths of the longest episode (matplotlib)."""
        from matplotlib.figure import Figure

        pairs = zip(self.score.episodes, self.score.overlays, strict=True)
        episode, predicted = max(pairs, key=lambda pair: pair[0].ticks)
        figure = Figure(figsize=(7.0, 6.0), layout="constrained")
        axes = figure.add_subplot(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axes.plot(episode.states[:, 0], episode.states[:, 1], color="#333333", linewidth=1.0, label="recorded")
        label = f"predicted, restarted every {self.horizon_s:.2g} s"
        axes.plot(predicted[:, 0], predicted[:, 1], ".", markersize=2.5, color="#D55E00", label=label)
        axes.legend()
        return figure

    def save(self, path: Path | str) -> list[Path]:
        """Write the recording with the predictions as .rrd (rerun): one file for each episode.

        Args:
            path: FILE.rrd; several episodes become FILE-1.rrd, FILE-2.rrd ...

        Returns:
            The files.

        Raises:
            DataError: a file cannot be written.
        """
        from carlab.recording.rerun.sink import episode_to_rrd

        first, written = Path(path), []
        several = len(self.score.episodes) > 1
        pairs = zip(self.score.episodes, self.score.overlays, strict=True)
        for number, (episode, overlay) in enumerate(pairs, start=1):
            file = first.with_name(f"{first.stem}-{number}.rrd") if several else first
            name = Path(self.recordings.names[number - 1]).name
            episode_to_rrd(episode, file, name, overlays={"predicted": overlay})
            written.append(file)
        return written

    def __repr__(self) -> str:
        """The table as text."""
        head = f"{'error after ' + format(self.horizon_s, '.2f') + ' s':20}"
        lines = [head + "".join(f"{column:>12}" for column in ERROR_COLUMNS)]
        rows = ("".join(f"{row[column]:12.4f}" for column in ERROR_COLUMNS) for row in self.table())
        lines += [f"{name:20}{values}" for name, values in zip(self.summary, rows, strict=True)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        rows = [[row["model"], *(row[column] for column in ERROR_COLUMNS)] for row in self.table()]
        return html_table([f"error after {self.horizon_s:.2f} s", *ERROR_COLUMNS], rows)


def predict(
    recording: RecordingLike | Iterable[RecordingLike],
    car: str | Path | CarFile = "sim",
    *,
    horizon_s: float = 1.0,
    stride_s: float = 0.25,
    holdout_share: float = 0.3,
    adapt: bool = False,
    keep_events: bool = False,
) -> PredictionErrors:
    """Predict a recording from many of its states, and compare the predictions with it.

    Args:
        recording: one recording or several: a ``Recording``, an ``EpisodeData``, or the path of an MCAP or a CSV.
        car: the simulator: a car file, its path, or a name.
        horizon_s: prediction horizon [s].
        stride_s: time between the starts of two predictions [s].
        holdout_share: length of the last part as a share of the recording, above 0 and at most 0.5.
        adapt: also predict with adaptation: drive force, steering trim, grip and force forward are estimated from the
            rows before each prediction.
        keep_events: also score prediction windows with events (collisions, a hand that moves the car). By default they
            are listed and left out.

    Returns:
        The errors of the model, with and without adaptation, of constant velocity and of no change. For a model of a
        diagnosis they agree with its report to about a tenth of a noise floor.

    Raises:
        ConfigError: an argument is invalid.
        DataError: the recording cannot be read, or holds no window of that length in which the car moves.
    """
    from carlab.diagnosis.score_recording import score_recording

    file = load_car(car)
    loaded = load_recordings(as_list(recording), "scored", file.simulator.latency_s())
    score = score_recording(
        loaded.episodes,
        file.simulator,
        noise=file.recording_noise,
        horizon_s=horizon_s,
        stride_s=stride_s,
        holdout_share=holdout_share,
        adapt=adapt,
        keep_events=keep_events,
    )
    noise = file.recording_noise
    return PredictionErrors(loaded, score, noise is not None and noise.adaptation is not None)
