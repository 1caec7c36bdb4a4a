"""Frames of videos and of the image topics of bags: the best of each stretch, in bounded memory."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from calib.core.arrays import AnyArray, GrayImage
from calib.core.errors import BadInputError, UsageError
from calib.core.files import VIDEOS, check_readable, hash_of, is_bag, one_line, shown
from calib.io.pictures import (
    Picture,
    declared_pixels,
    decode,
    decoded_picture,
    eight_bits,
    split_fields,
)

if TYPE_CHECKING:
    from calib.io.bag_topics import Topic

# ----------------------------------------------------------------------
# One pass over the frames. A stretch is a run of frames, of which the best is kept; when there are too
# many stretches, neighbours are joined and stretches are twice as long from then on. So the number of
# frames need not be known, and the same file gives the same frames.

_STRETCHES = 40
"""Between so many and twice as many frames are looked at."""
_FEWEST_STRETCHES = 8
_KEPT_PIXELS = 150_000_000
_SHARPNESS_PIXELS = 500_000
_MOST_PIXELS = 200_000_000


@dataclass(frozen=True)
class Frames:
    """The best frame of each stretch of a recording.

    Attributes
    ----------
    source : name of the file. sha256 : of the file. count : frames in all.
    pictures : named by source and number of the frame.
    """

    source: str
    sha256: str
    count: int
    pictures: tuple[Picture, ...]


def is_recording(path: Path) -> bool:
    """Whether a path is a video or a bag."""
    return is_bag(path) or (path.suffix.lower() in VIDEOS and not path.is_dir())


def read_frames(path: Path, topic: str | None = None) -> Frames:
    """Frames of a video, or of the image topic of a bag (the only one, or `topic`).

    Raises
    ------
    BadInputError : no video or bag that can be read, no picture in it, or several image topics.
    UsageError : a topic for a video.
    """
    if path.suffix.lower() in VIDEOS:
        if topic is not None:
            raise UsageError(f"--topic: {shown(path)} is a video, and a topic goes with a bag")
        stream = _video_frames(path)
    else:
        stream = _bag_frames(path, topic)
    name = shown(path.name)
    kept, count = _best(stream)
    if not count:
        raise BadInputError(f"{shown(path)}: holds no picture that can be decoded")
    digest = hash_of(path)
    pictures = tuple(
        Picture(f"{name} frame {number:05d}", digest, gray, (gray.shape[1], gray.shape[0]), second=second)
        for number, (gray, second) in ((number, split_fields(frame)) for number, frame in kept)
    )
    return Frames(name, digest, count, pictures)


@dataclass(frozen=True)
class _Best:
    number: int
    worth: float
    gray: GrayImage


def _best(stream: Iterable[GrayImage]) -> tuple[list[tuple[int, GrayImage]], int]:
    """Number and picture of the best frame of each stretch, and how many frames there were.

    The best one is sharp and rests: what moves before a rolling shutter is sheared, however sharp.
    """
    stretches: list[_Best] = []
    length, count = 1, 0
    for number, (gray, moved) in enumerate(_measure_motion(stream)):
        count += 1
        most = 2 * max(_FEWEST_STRETCHES, min(_STRETCHES, _KEPT_PIXELS // (2 * gray.size)))
        sharpness = _sharpness(split_fields(gray)[0])
        one = _Best(number, sharpness**2 / max(sharpness + moved, 1e-9), gray)
        if number // length < len(stretches):
            stretches[-1] = _better(stretches[-1], one)
        else:
            stretches.append(one)
        if len(stretches) > most:
            pairs = [stretches[k : k + 2] for k in range(0, len(stretches), 2)]
            stretches = [_better(pair[0], pair[-1]) for pair in pairs]
            length *= 2
    return [(one.number, one.gray) for one in stretches], count


def _better(before: _Best, after: _Best) -> _Best:
    return before if after.worth <= before.worth else after


def _measure_motion(stream: Iterable[GrayImage]) -> Iterator[tuple[GrayImage, float]]:
    """Each frame, and the larger of its mean square differences from the one before and the one after.

    Of a camera that gives each frame twice one of them is nothing.
    """
    before: GrayImage | None = None
    moved = 0.0
    for gray in stream:
        # A decoder may hand out the same memory again.
        after = gray.copy()
        if before is not None:
            step = _mean_square_difference(before, after)
            yield before, max(moved, step)
            moved = step
        before = after
    if before is not None:
        yield before, moved


def _mean_square_difference(one: GrayImage, other: GrayImage) -> float:
    """Mean square difference of two frames, 0 of frames of unlike sizes."""
    if one.shape != other.shape:
        return 0.0
    n = 1 + one.size // _SHARPNESS_PIXELS
    return float(np.mean(np.square(one[::n].astype(np.int16) - other[::n], dtype=np.float32)))


def _sharpness(gray: GrayImage) -> float:
    """Mean square of the second differences; pixels are left out, not averaged, which would hide a blur."""
    n = 1 + gray.size // _SHARPNESS_PIXELS
    rows, columns = gray[::n].astype(np.int16), gray[:, ::n].astype(np.int16)
    along, down = np.diff(rows, 2, axis=1), np.diff(columns, 2, axis=0)
    return sum(float(np.mean(np.square(d, dtype=np.float32))) if d.size else 0.0 for d in (along, down))


def _video_frames(path: Path) -> Iterator[GrayImage]:
    for frame in timed_frames(path)[1]:
        gray = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        yield np.asarray(gray, dtype=np.uint8)


# ----------------------------------------------------------------------
# All frames of a video or of a camera, in colour, with their times.


@dataclass
class Times:
    """What the times of frames are worth.

    Attributes
    ----------
    arrival : whether they are those at which frames came, not those of a file. rate_hz : as the file says.
    stamps_s : of all frames so far.
    """

    arrival: bool
    rate_hz: float
    stamps_s: list[float] = field(default_factory=list)

    @property
    def usable(self) -> bool:
        """Whether they increase."""
        return all(b > a for a, b in pairwise(self.stamps_s))

    def settled_s(self) -> list[float]:
        """Times from the first frame on; counted where the stamps do not increase. Raises `BadInputError`."""
        if self.usable:
            times = [t - self.stamps_s[0] for t in self.stamps_s]
            return times if self.arrival else _unrounded_s(times)
        if not 1.0 <= self.rate_hz <= 1000.0:
            raise BadInputError("the video has no times that increase, and tells no rate of frames")
        return [k / self.rate_hz for k in range(len(self.stamps_s))]

    def astray_s(self) -> float:
        """By how much counted times leave stamps that increase between two places where they do not.

        Less than that of frames that are decoded in another order, or of a rate that is told as 30 for 29.97,
        is 0.
        """
        if self.usable or self.rate_hz <= 0:
            return 0.0
        stamps = np.array(self.stamps_s)
        k = np.arange(len(stamps))
        begins = np.flatnonzero(np.r_[True, np.diff(stamps) <= 0])
        begin = begins[np.searchsorted(begins, k, side="right") - 1]
        counted = (k - begin) / self.rate_hz
        off = np.abs(stamps - stamps[begin] - counted)
        return float(
            np.where(off > np.maximum(_REORDERED / self.rate_hz, _TOLD_RATE * counted), off, 0.0).max()
        )

    def words(self) -> str:
        """One sentence."""
        steps = np.diff(self.settled_s()) * 1e3
        if len(steps) == 0:
            return "one frame, so no times"
        usual, low, high = float(np.median(steps)), float(steps.min()), float(steps.max())
        if not self.usable:
            counted = f"the stamps do not increase: times are counted at the {self.rate_hz:g} Hz of the file"
            if not self.astray_s():
                return counted
            back = next(k for k, step in enumerate(np.diff(self.stamps_s)) if step <= 0) + 1
            return (
                f"{counted}, and are up to {self.astray_s():.2f} s off its stamps: cut the video at frame "
                f"{back}, where they go back"
            )
        span = f"a frame each {usual:.2f} ms ({low:.2f} to {high:.2f})"
        if self.arrival:
            return f"times of arrival at this computer, {span}; later than the exposure by an unknown time"
        if high - low < 0.01 * usual + 1.0:
            return f"times from the file, {span}: even, which says nothing of how even the camera was"
        return f"times from the file, {span}"


_REORDERED, _TOLD_RATE = 2.5, 0.01
"""Frames that decoding may put between two stamps, and by what share a file's rate may be off."""
_LEAST_STEP_MS, _ROUNDING_MS = 4.0, 0.6
"""A step that a millisecond more or less leaves one step, and what rounding leaves about a fitted line."""


def _unrounded_s(times_s: list[float]) -> list[float]:
    """The even times of which these are the whole milliseconds, as in Matroska and WebM; else as they are."""
    ms = 1e3 * np.array(times_s)
    steps = np.diff(ms)
    if len(steps) < 2 or np.abs(ms - np.rint(ms)).max() > 1e-3 or np.median(steps) < _LEAST_STEP_MS:
        return times_s
    k = np.r_[0.0, np.cumsum(np.rint(steps / np.median(steps)))]
    step, first = np.polyfit(k, ms, 1)
    if np.abs(first + step * k - ms).max() > _ROUNDING_MS:
        return times_s
    return list((1e-3 * step * k).tolist())


def opened_video(source: int | str) -> cv2.VideoCapture | None:
    """A video, a camera (its number) or a stream; None where it cannot be opened.

    As with pictures, the sensor's own pixels count, however the camera was held.
    """
    # The binding has one form for a number and one for a name.
    video = cv2.VideoCapture()
    video.open(source)
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    if "://" in str(source) and int(video.get(cv2.CAP_PROP_FOURCC)) == _MJPEG:
        # As it comes: OpenCV would scale all frames to the first one's size, also once that is switched.
        video.set(cv2.CAP_PROP_FORMAT, -1)
    return video if video.isOpened() else None


_MJPEG = cv2.VideoWriter.fourcc(*"MJPG")
_MOST_DAMAGED = 30
"""Damaged frames in turn, about a second of them, from which on a stream is lost."""


def next_frame(video: cv2.VideoCapture) -> AnyArray | None:
    """The next whole frame (H, W, 3) of a video that `opened_video` opened; None where it ends or is lost."""
    for _ in range(_MOST_DAMAGED):
        there, frame = video.read()
        if not there or frame is None:
            return None
        # Bytes as they came are one row. The property is no help: DirectShow says -1 for any camera.
        if len(frame) > 1:
            return frame
        data = frame.tobytes()
        if 0 < declared_pixels(data) <= _MOST_PIXELS and (whole := decode(data, colour=True)) is not None:
            return whole
    return None


def timed_frames(source: Path | int | str) -> tuple[Times, Iterator[np.ndarray[Any, Any]]]:
    """Frames (H, W, 3) of a video (a path), or of a camera (its number, or a stream's address) until it ends.

    The `Times` grow with the frames. Raises `BadInputError` where it cannot be opened.
    """
    name = shown(source) if isinstance(source, Path | str) else f"camera {source}"
    if isinstance(source, Path):
        check_readable(source)
    video = opened_video(str(source) if isinstance(source, Path) else source)
    if video is None:
        what = "camera that can be opened"
        if isinstance(source, Path):
            what = "video that can be read; one whose end is missing, or that holds sound alone, is none"
        raise BadInputError(f"{name}: is not a {what}")
    times = Times(not isinstance(source, Path), float(video.get(cv2.CAP_PROP_FPS)))

    def frames() -> Iterator[np.ndarray[Any, Any]]:
        black = True
        try:
            while True:
                frame = next_frame(video)
                if frame is None:
                    break
                if frame.shape[0] * frame.shape[1] > _MOST_PIXELS:
                    raise BadInputError(f"{name}: frames have over {_MOST_PIXELS // 10**6} million pixels")
                black = black and not frame.any()
                # The monotonic clock of Windows has steps of 16 ms.
                stamp = time.perf_counter() if times.arrival else 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
                times.stamps_s.append(stamp)
                yield frame
        finally:
            video.release()
        if black and times.stamps_s and isinstance(source, Path):
            # OpenCV converts no frames that are marked as interlaced, and hands out zeros.
            raise BadInputError(
                f"{name}: all of its {len(times.stamps_s)} frames come out black; where it is interlaced, as "
                f"of a camcorder, write it anew: ffmpeg -i {shown(source.name)} -vf yadif progressive.mp4"
            )

    return times, frames()


# ----------------------------------------------------------------------
# Messages of sensor_msgs/Image (encodings of sensor_msgs/image_encodings) and CompressedImage.

_IMAGE, _COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
_COLOURS = {
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    # ROS names the pattern by the first two pixels of the first row, OpenCV by those of the second.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
}
_GREY = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}


def _bag_frames(path: Path, topic: str | None) -> Iterator[GrayImage]:
    from calib.io.bags import opened_bag

    with opened_bag(path) as stream:
        chosen = _image_topic(path, stream.topics, topic)
        where = f"{shown(path)}: {one_line(chosen.name)[:80]}"
        damage: BadInputError | None = None
        count = 0
        for _, _, message in stream.messages([chosen.name]):
            try:
                if chosen.kind == _COMPRESSED:
                    gray = decoded_picture(bytes(message.data), where, where, "").gray
                else:
                    gray = _decode_image(message, where)
            except BadInputError as error:
                # One damaged frame among many is no loss; if there is no other, it is the reason.
                damage = damage or error
                continue
            count += 1
            yield gray
        if damage is not None and not count:
            raise damage


def _image_topic(path: Path, topics: Sequence[Topic], wanted: str | None) -> Topic:
    """The topic of pictures, the only one or `wanted`. Raises `BadInputError` for none and for several."""
    from calib.io.bag_topics import used_topics

    pictures = used_topics([one for one in topics if one.kind in (_IMAGE, _COMPRESSED)])
    listed = ", ".join(one_line(one.name)[:80] for one in pictures) or "none"
    named = [one for one in pictures if wanted in (None, one.name)]
    if wanted is not None and not named:
        raise BadInputError(f"{shown(path)}: has no image topic {one_line(wanted)[:80]}; found {listed}")
    if not named:
        raise BadInputError(
            f"{shown(path)}: holds no pictures, expected a topic of {_IMAGE} or {_COMPRESSED}"
        )
    if len(named) > 1:
        raise BadInputError(f"{shown(path)}: has several image topics, choose with --topic: {listed}")
    return named[0]


def _decode_image(message: Any, where: str) -> GrayImage:
    """Grey values of a sensor_msgs/Image."""
    encoding = str(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    channels, code = _COLOURS.get(encoding, (1, None))
    kind = np.dtype(_GREY.get(encoding, "u1")).newbyteorder(">" if message.is_bigendian else "<")
    if code is None and encoding not in _GREY:
        known = ", ".join([*_GREY, *_COLOURS])
        raise BadInputError(
            f"{where}: has pictures in {one_line(encoding)[:40]!r}, expected {known} or compressed ones"
        )
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    row = width * channels * kind.itemsize
    if min(height, width) < 1 or step < row or len(data) < height * step:
        raise BadInputError(
            f"{where}: a picture of {width}x{height} px in {encoding} has {len(data)} bytes in rows of {step}"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    if code is None:
        return eight_bits(rows.view(kind).reshape(height, width))
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows.reshape(height, width)
    return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)
