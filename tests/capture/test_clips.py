"""Clips brought onto one clock by what they share, and the frames that stand for the same moments."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mifit.capture import Capture, import_capture
from mifit.capture.clips import aligned, describe, lag, synchronise
from mifit.capture.sources import ImageFiles, Video, open_sources
from mifit.errors import InputError


def film(
    path: Path, begin: float, seconds: float, rate: float = 25.0, size: tuple[int, int] = (96, 72), clap: bool = False
) -> Video:
    """A clip of one scene from a moment on: a disc that wanders unevenly, and a clap at 1.1 s of the scene."""
    count = round(seconds * rate)
    with_sound = path.suffix == ".mp4"
    frames = []
    for t in begin + np.arange(count) / rate:
        frame = np.full((size[1], size[0], 3), 40, np.uint8)
        phase = 2.0 * t + 1.3 * np.sin(1.7 * t) + 0.8 * np.sin(4.1 * t)
        at = (0.5 + 0.3 * np.sin(phase)) * size[0], (0.5 + 0.2 * np.cos(1.3 * phase)) * size[1]
        cv2.circle(frame, (round(16 * at[0]), round(16 * at[1])), round(16 * size[0] / 8), (200, 220, 240), -1, 16, 4)
        frames.append(frame)
    if not with_sound:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, size)
        for frame in frames:
            writer.write(frame)
        writer.release()
        return Video.open(path, path.stem)
    write_with_sound(path, frames, rate, 1.1 - begin if clap else None)
    return Video.open(path, path.stem)


def write_with_sound(path: Path, frames: list[np.ndarray], rate: float, clap: float | None) -> None:
    """Write RGB frames with noise as sound, and a clap in it at so many seconds."""
    av = pytest.importorskip("av", reason="PyAV, which reads and writes sound, is not installed")
    hertz, rng = 44100, np.random.default_rng(0)
    sound = 0.002 * rng.normal(size=round(len(frames) / rate * hertz))
    if clap is not None:
        burst = 0.5 * np.exp(-np.arange(4000) / 400) * rng.normal(size=4000)
        start = round(clap * hertz)
        sound[start : start + 4000] += burst[: max(len(sound) - start, 0)]
    with av.open(str(path), "w") as out:
        video, audio = out.add_stream("libx264", rate=round(rate)), out.add_stream("aac", rate=hertz)
        video.height, video.width, video.pix_fmt, video.options = *frames[0].shape[:2], "yuv420p", {"crf": "10"}
        audio.layout = "mono"
        for frame in frames:
            out.mux(video.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        out.mux(video.encode())
        for k in range(0, len(sound), 1024):
            part = av.AudioFrame.from_ndarray(sound[None, k : k + 1024].astype(np.float32), "fltp", "mono")
            part.sample_rate, part.pts = hertz, k
            out.mux(audio.encode(part))
        out.mux(audio.encode())


@pytest.mark.parametrize("late", [0.0, 0.4, -0.73])
def test_a_lag_is_found_to_a_fraction_of_a_sample(late: float) -> None:
    t = np.arange(0.0, 4.0, 0.01)
    event = lambda t: np.exp(-((t - 1.9) ** 2) / 0.003) + 0.5 * np.exp(-((t - 2.4) ** 2) / 0.01)  # noqa: E731
    found, correlation = lag(event(t), event(t[:-50] - late), 100.0)
    assert found == pytest.approx(late, abs=0.002) and correlation > 0.95


@pytest.mark.parametrize(("rate", "size"), [(25.0, (96, 72)), (30.0, (64, 48))])
def test_clips_without_sound_are_brought_into_step_by_motion(tmp_path: Path, rate: float, size) -> None:
    first = film(tmp_path / "left.avi", 0.0, 6.0)
    second = film(tmp_path / "right.avi", 0.413, 5.2, rate, size)
    starts = synchronise([first, second])
    assert starts[1].by == "motion" and starts[1].seconds == pytest.approx(0.413, abs=0.25 / 25)
    moments = aligned([first, second], [start.seconds for start in starts])
    shown = [np.array(one.numbers) / one.source.rate for one in moments]
    assert len(shown[0]) == len(shown[1]) > 5.0 * 25
    assert np.abs(shown[0] - (shown[1] + 0.413)).max() < 0.6 / min(rate, 25.0)
    text = "\n".join(describe(moments, starts))
    assert "right begins 0.41" in text and "after left, by motion" in text
    assert ("frames a second differ (left 25, right 30)" in text) == (rate != 25.0)
    assert len(describe(moments, [])) == (rate != 25.0)


def test_a_clap_is_heard(tmp_path: Path) -> None:
    clips = [film(tmp_path / f"{name}.mp4", begin, 3.0, clap=True) for name, begin in (("a", 0.0), ("b", 0.3))]
    start = synchronise(clips)[1]
    assert start.by == "sound" and start.seconds == pytest.approx(0.3, abs=0.003)


def test_clips_of_different_scenes_are_taken_to_begin_together_and_it_is_said(tmp_path: Path) -> None:
    first, still = film(tmp_path / "a.avi", 0.0, 3.0), tmp_path / "b.avi"
    writer = cv2.VideoWriter(str(still), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for noise in np.random.default_rng(0).integers(0, 255, (75, 48, 64, 3), dtype=np.uint8):
        writer.write(noise)
    writer.release()
    clips = [first, Video.open(still, "b")]
    starts = synchronise(clips)
    assert starts[1].by == "none" and starts[1].seconds == 0.0
    assert "warning: nothing in it moves or sounds as in a" in describe(aligned(clips), starts)[0]


def test_clips_need_a_moment_in_common_and_a_start_each(tmp_path: Path) -> None:
    clips = [film(tmp_path / f"{name}.avi", 0.0, 1.0) for name in "ab"]
    with pytest.raises(InputError, match=r"show no moment in common when they begin at 0.00, 5.00 s; give --offset"):
        aligned(clips, [0.0, 5.0])
    with pytest.raises(InputError, match="found 1 starts, expected one for each of 2 videos"):
        aligned(clips, [0.0])
    assert [one.length for one in aligned(clips, [0.0, 0.2])] == [20, 20]
    assert aligned(clips, [0.0, 0.2])[0].numbers[0] == 5


def test_a_part_of_the_clips_is_taken(tmp_path: Path) -> None:
    clips = [film(tmp_path / f"{name}.avi", 0.0, 2.0) for name in "ab"]
    first, second = aligned(clips, [0.0, 0.2], (0.5, 1.0))
    assert (first.numbers[0], first.numbers[-1]) == (13, 25) and (second.numbers[0], second.numbers[-1]) == (8, 20)
    with pytest.raises(InputError, match=r"trim: found 3 to inf s, expected a part of 0.20 to 1.96 s of .*a.avi"):
        aligned(clips, [0.0, 0.2], (3.0, np.inf))
    kept = Capture.load(import_capture(tmp_path / "out", [clip.path for clip in clips], trim=(1.5, np.inf), every=4))
    assert kept.timesteps == (0, 1, 2)


def test_clips_of_unequal_length_and_size_become_a_capture(tmp_path: Path) -> None:
    clips = [film(tmp_path / "a.avi", 0.0, 1.0), film(tmp_path / "b.avi", 0.2, 0.6, size=(64, 48))]
    capture = Capture.load(import_capture(tmp_path / "out", [clip.path for clip in clips], starts=[0.0, 0.2], every=3))
    assert capture.timesteps == (0, 1, 2, 3, 4)
    assert [capture.views[name].width for name in ("a", "b")] == [96, 64]
    for t in capture.timesteps:
        small = cv2.resize(capture.frame("a", t).image, (64, 48), interpolation=cv2.INTER_AREA)
        assert np.abs(small - capture.frame("b", t).image).mean() < 0.01


def test_photographs_are_cameras_of_one_moment(tmp_path: Path, folder: Path) -> None:
    paths = [folder / "images" / name / "0000.png" for name in ("left", "right")]
    sources = open_sources((), paths, ["l", "r"])
    assert [(s.name, s.length) for s in sources] == [("l", 1), ("r", 1)] and isinstance(sources[0], ImageFiles)
    with pytest.raises(InputError, match="names: found l, expected 2 different ones"):
        open_sources((), paths, ["l"])
