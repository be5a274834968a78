"""Clips of several cameras on one clock: how much later each began, and which of their frames show the same moments.

Two clips of one scene share what happens: the sound of a clap, or how much the picture moves from frame to frame. The
lag at which two such signals correlate best is the time between the starts, to a fraction of a frame.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.sources import Source, Video, opened_video
from mifit.core.process import decoding
from mifit.errors import InputError
from mifit.progress import Progress, silent

SOUND_RATE = 2000
"""Values of a sound's envelope per second."""
MOTION_RATE = 480
"""Values per second between which the motion of frames is interpolated."""


@dataclass(frozen=True)
class Start:
    """By how many ``seconds`` a clip began later than the first one.

    It was found ``by`` ``sound``, ``motion``, or ``none``: nothing in common was found, and the clips are taken to
    begin together. ``correlation`` is that of the two signals at that lag, -1..1.
    """

    seconds: float = 0.0
    by: str = "none"
    correlation: float = 1.0


def synchronise(videos: Sequence[Video], progress: Progress = silent) -> list[Start]:
    """Starts of clips, the first one's at 0: by sound where all have sound and it can be read, else by motion.

    Sounds count from a correlation of 0.3 on, motions, which have fewer values to agree on, from 0.6.
    """
    sounds = [sound for sound in (_sound(video.path) for video in videos) if sound is not None]
    if len(sounds) == len(videos):
        found = [lag(sounds[0], sound, SOUND_RATE) for sound in sounds[1:]]
        if min((r for _, r in found), default=1.0) >= 0.3:
            return [Start(), *(Start(-seconds, "sound", r) for seconds, r in found)]
    motions = []
    for k, video in enumerate(videos):
        progress("Synchronising", k, len(videos))
        motions.append(_motion(video))
    progress("Synchronising", len(videos), len(videos))
    found = [lag(motions[0], motion, MOTION_RATE) for motion in motions[1:]]
    return [Start(), *(Start(-s, "motion", r) if r >= 0.6 else Start(correlation=r) for s, r in found)]


def lag(first: NDArray, second: NDArray, rate: float) -> tuple[float, float]:
    """Seconds by which what happens comes later in the second signal, and the correlation there.

    The signals share a second at the least, or half of the shorter one.
    """
    from scipy.signal import correlate  # slow to load, and every command loads this module

    a, b = (np.asarray(x, dtype=np.float64) - np.mean(x) for x in (first, second))
    ones = np.ones(len(a)), np.ones(len(b))
    product = correlate(b, a, method="fft")
    within = correlate(b * b, ones[0], method="fft"), correlate(ones[1], a * a, method="fft")
    # All of the shorter signal, and of the longer one what it lies beside: a few moments alike are no match.
    energy = (a @ a) * within[0] if len(a) <= len(b) else (b @ b) * within[1]
    shared = correlate(ones[1], ones[0], method="fft")
    least = min(rate, 0.5 * min(len(a), len(b)))
    score = np.where(shared >= least, product / np.sqrt(np.maximum(energy, 1e-12 * energy.max() + 1e-30)), -1.0)
    peak = int(score.argmax())
    shift = 0.0
    if 0 < peak < len(score) - 1 and score[peak - 1] > -1 and score[peak + 1] > -1:
        left, middle, right = score[peak - 1 : peak + 2]
        bend = left - 2 * middle + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return (peak + shift - (len(a) - 1)) / rate, float(score[peak])


def _sound(path: Path) -> NDArray[np.float64] | None:
    """Onsets of a clip's sound, `SOUND_RATE` a second; None without sound, or without PyAV to read it."""
    if importlib.util.find_spec("av") is None:
        return None
    import av

    rate = 16 * SOUND_RATE
    parts = []
    try:
        with av.open(str(path)) as container:
            if not container.streams.audio:
                return None
            resampler = av.AudioResampler(format="flt", layout="mono", rate=rate)
            stream = container.streams.audio[0]
            late = float((stream.start_time or 0) * stream.time_base) if stream.time_base else 0.0
            for frame in container.decode(stream):
                parts += [part.to_ndarray().ravel() for part in resampler.resample(frame)]
    except (av.FFmpegError, ValueError, OSError):  # a sound that can't be read is none
        return None
    if not parts:
        return None
    samples = np.concatenate([np.zeros(max(round(late * rate), 0)), *parts])
    steps = np.abs(np.diff(samples, prepend=0.0))
    loud = np.sqrt(steps[: len(steps) // 16 * 16].reshape(-1, 16).mean(axis=1))
    return np.maximum(np.diff(loud, prepend=0.0), 0.0)


def _motion(video: Video) -> NDArray[np.float64]:
    """How much a clip's picture changes from frame to frame, `MOTION_RATE` values a second."""
    changes, before = [], None
    for frame in _small_frames(video):
        if before is not None:
            changes.append(float(np.abs(frame - before).mean()))
        before = frame
    if len(changes) < 2:
        return np.zeros(2)
    times = (np.arange(len(changes)) + 0.5) / video.rate
    grid = np.arange(0.0, len(changes) / video.rate, 1.0 / MOTION_RATE)
    return np.interp(grid, times, np.log(np.array(changes) + 1e-2 * max(changes) + 1e-9))


def _small_frames(video: Video) -> Iterator[NDArray[np.float32]]:
    with opened_video(video.path) as reader:
        while True:
            with decoding():
                there, frame = reader.read()
            if not there:
                return
            grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            height = max(round(160 * grey.shape[0] / grey.shape[1]), 1)
            yield cv2.resize(grey, (160, height), interpolation=cv2.INTER_AREA).astype(np.float32)


@dataclass(frozen=True)
class Moments:
    """Some frames of a source, ``numbers``, ascending: a source again.

    ``off`` is the mean distance in frames between the moments and the frames that stand for them.
    """

    source: Source
    numbers: tuple[int, ...]
    off: float = 0.0

    @property
    def name(self) -> str:
        """Camera name."""
        return self.source.name

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.source.size

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self.numbers)

    def files(self, numbers: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """See `Source.files`."""
        return self.source.files([self.numbers[i] for i in numbers])


def aligned(
    sources: Sequence[Source], starts: Sequence[float] = (), trim: tuple[float, float] | None = None
) -> list[Moments]:
    """The moments that all sources show, one for each frame of the slowest clip.

    Clips may differ in length, rate and size. Lists of images are in step, one moment an image. ``starts`` are the
    seconds by which each clip began later than the first one, by default all at once; ``trim`` those of the first clip
    from which, and up to which, moments are taken. InputError for unequal numbers of images, starts that aren't as many
    as the clips, or no moment that all clips show.
    """
    clips = [source for source in sources if isinstance(source, Video)]
    if starts and len(starts) != len(clips):
        raise InputError(f"found {len(starts)} starts, expected one for each of {len(clips)} videos")
    if not clips:
        if trim is not None:
            raise InputError("trim: found with images, expected it with videos")
        for other in sources[1:]:
            if other.length != sources[0].length:
                raise InputError(
                    f"{_place(other)}: found {other.length} frames, expected {sources[0].length} as in "
                    f"{_place(sources[0])}; synchronised cameras have equally many"
                )
        return [Moments(source, tuple(range(source.length))) for source in sources]
    begun = np.array(starts or [0.0] * len(clips), dtype=np.float64)
    slowest = int(np.argmin([clip.rate for clip in clips]))
    times = begun[slowest] + np.arange(clips[slowest].length) / clips[slowest].rate
    exact = np.stack([(times - begin) * clip.rate for begin, clip in zip(begun, clips, strict=True)])
    numbers = np.round(exact).astype(int)
    shown = np.all([(n >= 0) & (n < clip.length) for n, clip in zip(numbers, clips, strict=True)], axis=0)
    if not shown.any():
        raise InputError(
            f"{', '.join(str(clip.path) for clip in clips)}: show no moment in common when they begin at "
            f"{', '.join(f'{s:.2f}' for s in begun)} s; give --offset"
        )
    if trim is not None:
        common = times[shown]
        shown &= (times >= trim[0]) & (times <= trim[1])
        if not shown.any():
            raise InputError(
                f"trim: found {trim[0]:g} to {trim[1]:g} s, expected a part of {common[0]:.2f} to {common[-1]:.2f} s "
                f"of {clips[0].path} that all clips show"
            )
    off = np.abs(exact - numbers)[:, shown].mean(axis=1)
    return [
        Moments(clip, tuple(row[shown].tolist()), float(o)) for clip, row, o in zip(clips, numbers, off, strict=True)
    ]


def describe(moments: Sequence[Moments], starts: Sequence[Start]) -> list[str]:
    """What is worth saying of clips that were put on one clock, in lines; ``starts`` are those that were found."""
    lines = []
    for one, start in zip(moments[1:], starts[1:], strict=False):
        if start.by == "none":
            lines.append(
                f"{one.name}: warning: nothing in it moves or sounds as in {moments[0].name} "
                f"(correlation {start.correlation:.2f}); taken to begin together, or give --offset"
            )
        else:
            lines.append(
                f"{one.name} begins {abs(start.seconds):.3f} s {'before' if start.seconds < 0 else 'after'} "
                f"{moments[0].name}, by {start.by} (correlation {start.correlation:.2f}); "
                f"frames lie {one.off:.2f} of a frame apart"
            )
    rates = {m.name: m.source.rate for m in moments if isinstance(m.source, Video)}
    if len({round(rate, 2) for rate in rates.values()}) > 1:
        text = ", ".join(f"{name} {rate:.4g}" for name, rate in rates.items())
        lines.append(f"frames a second differ ({text}): frames are paired by time")
    return lines


def _place(source: Source) -> str:
    paths = getattr(source, "paths", None)
    return str(paths[0].parent) if paths else source.name
