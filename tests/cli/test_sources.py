"""Where views may come from: HEIC and AVIF, videos, bags, and the folder of a whole rig."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calib.io.frames import read_frames
from calib.io.pictures import read_picture

RADIAL2 = ("--model", "radial2")


@pytest.fixture(scope="module")
def shipped(project_root: Path) -> list[np.ndarray]:
    paths = sorted((project_root / "images").glob("view*.png"))
    return [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]


def _video(path: Path, frames: list[np.ndarray]) -> Path:
    height, width = frames[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 30.0, (width, height))
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


@pytest.fixture(scope="module")
def video(shipped: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each view for five frames, of which the third is sharp."""
    frames = []
    for view in shipped:
        blurred = cv2.GaussianBlur(view, (0, 0), 1.5)
        frames += [view if k == 2 else blurred for k in range(5)]
    return _video(tmp_path_factory.mktemp("video") / "clip.avi", frames)


def test_of_each_stretch_the_sharpest_frame(video: Path, shipped: list[np.ndarray]) -> None:
    found = read_frames(video)
    assert found.count == 5 * len(shipped)
    assert 40 <= len(found.pictures) <= 80
    for one, again in zip(found.pictures, read_frames(video).pictures, strict=True):
        assert one.name == again.name
        np.testing.assert_array_equal(one.gray, again.gray)
    numbers = [int(one.name.split()[-1]) for one in found.pictures]
    sharp = [n for n in numbers if n % 5 == 2]
    assert len(sharp) == len(shipped), "no sharp frame was passed over"
    np.testing.assert_array_equal(found.pictures[numbers.index(7)].gray, shipped[1])


def test_of_each_stretch_a_frame_at_rest(shipped: list[np.ndarray], tmp_path: Path) -> None:
    """A board that moves by three pixels a frame is as sharp as one at rest, where the exposure is short."""
    frames = []
    for view in shipped:
        moving = [np.roll(view, 3 * k, axis=1) for k in range(4, 0, -1)]
        frames += [*moving, view, view, view]
    numbers = [int(one.name.split()[-1]) for one in read_frames(_video(tmp_path / "a.avi", frames)).pictures]
    assert {n // 7 for n in numbers if n % 7 == 5} == set(range(len(shipped)))


def test_a_video_makes_the_camera_of_its_views(calib, video, project_root, tmp_path) -> None:
    """Of each place of the board one frame is used; the others are copies."""
    rig, other = tmp_path / "rig.yaml", tmp_path / "other.yaml"
    ended = calib("intrinsics", video, *RADIAL2, "--rig", rig)
    assert (
        "clip.avi: 85 frames, looked at the sharpest at rest of each of 43 stretches, board in 43"
        in ended.err
    )
    calib("intrinsics", project_root / "images", *RADIAL2, "--rig", other)
    camera, still = (yaml.safe_load(path.read_text())["camera"] for path in (rig, other))
    assert camera["fx_px"] == pytest.approx(still["fx_px"], abs=3 * still["sigma"]["fx_px"])
    assert camera["views"] == 17
    assert camera["rms_px"] < 1.1 * still["rms_px"]
    inputs = yaml.safe_load(rig.read_text())["provenance"]["inputs"]["camera"]
    assert list(inputs) == ["clip.avi"]


def _bag(path: Path, views: list[np.ndarray], encoding: str, topics: tuple[str, ...] = ("/image",)) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/CompressedImage" if encoding == "png" else "sensor_msgs/msg/Image"
    make, time = store.types[kind], store.types["builtin_interfaces/msg/Time"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, view in enumerate(views):
                header = store.types["std_msgs/msg/Header"](stamp=time(k, 0), frame_id="")
                if encoding == "png":
                    message = make(header=header, format="png", data=cv2.imencode(".png", view)[1])
                else:
                    data = view if encoding in ("mono8", "odd") else np.repeat(view, 3, axis=1)
                    if encoding == "mono16":
                        data = (view.astype("<u2") * 200).view(np.uint8)
                    # Rows may be longer than their pixels.
                    data = np.pad(data, ((0, 0), (0, 4)))
                    message = make(
                        header=header, height=view.shape[0], width=view.shape[1], encoding=encoding,
                        is_bigendian=0, step=data.shape[1], data=data.ravel(),
                    )  # fmt: skip
                writer.write(connection, 1_000_000 * k, store.serialize_cdr(message, kind))
    return path


@pytest.mark.parametrize("encoding", ["mono8", "mono16", "bgr8", "png"])
def test_frames_of_a_bag(shipped, tmp_path, encoding) -> None:
    found = read_frames(_bag(tmp_path / "bag", shipped[:3], encoding))
    assert found.count == len(found.pictures) == 3
    for one, view in zip(found.pictures, shipped, strict=False):
        gain = 255.0 / np.percentile(view, 99.9) if encoding == "mono16" else 1.0
        np.testing.assert_allclose(one.gray, np.minimum(255.0, gain * view), atol=1)


def test_a_bag_makes_a_camera(calib, shipped, tmp_path) -> None:
    rig, bag = tmp_path / "rig.yaml", _bag(tmp_path / "bag", shipped, "mono8", ("/left", "/right"))
    ended = calib("intrinsics", bag, *RADIAL2, "--rig", rig)
    assert (ended.code, rig.exists()) == (3, False)
    assert ended.sentence == f"{bag}: has several image topics, choose with --topic: /left, /right"
    assert calib("intrinsics", bag, *RADIAL2, "--rig", rig, "--topic", "/left").code == 0
    assert yaml.safe_load(rig.read_text())["camera"]["views"] == 17


def test_recordings_that_cannot_be_read(calib, shipped, video, project_root, tmp_path) -> None:
    rig, broken = ("--rig", tmp_path / "rig.yaml"), tmp_path / "broken.mp4"
    broken.write_bytes(b"no video at all" * 100)
    clips = tmp_path / "clips"
    clips.mkdir()
    shutil.copy(video, clips)
    odd = _bag(tmp_path / "odd", shipped[:1], "odd")
    for words, code, says in (
        ((broken,), 3, f"{broken}: is not a video that can be read"),
        ((tmp_path / "none.mp4",), 3, f"{tmp_path / 'none.mp4'}: cannot be read: No such file"),
        ((video, "--topic", "/image"), 2, "is a video, and a topic goes with a bag"),
        ((project_root / "images", "--topic", "/image"), 2, "--topic: goes with a bag"),
        ((odd,), 3, f"{odd}: /image: has pictures in 'odd', expected mono8"),
        ((odd, "--topic", "/depth"), 3, f"{odd}: has no image topic /depth; found /image"),
        ((clips,), 3, f"{clips}: holds no pictures, but clip.avi; give that recording itself"),
    ):
        ended = calib("intrinsics", *words, *rig)
        assert ended.code == code
        assert says in ended.sentence
    assert not rig[1].exists()


def test_the_folder_of_a_rig_where_its_pictures_are_meant(calib, project_root, tmp_path) -> None:
    shutil.copytree(project_root / "images", tmp_path / "mine" / "images")
    (tmp_path / "mine" / "images" / "notes.txt").write_text("taken in May\n")
    (tmp_path / "mine" / "images" / "clip.mp4").write_bytes(b"")
    rig = tmp_path / "rig.yaml"
    ended = calib("intrinsics", tmp_path / "mine", *RADIAL2, "--rig", rig)
    assert ended.code == 0
    folder = tmp_path / "mine"
    assert f"{folder}: holds no pictures itself; taking those in {folder / 'images'}" in ended.err
    assert "not used: notes.txt: is no picture (png, jpg" in ended.out
    assert "not used: clip.mp4: is a recording; give it by itself, not its folder" in ended.out
    ended = calib("extrinsics", folder, "--rig", rig)
    assert ended.code == 0
    assert f"taking those in {folder / 'images' / 'plane'}" in ended.err


@pytest.mark.parametrize("turns", [0, 1])
def test_heic_and_avif(calib, shipped, tmp_path, monkeypatch, turns) -> None:
    """Pixels are the sensor's, whichever way the camera was held."""
    import pillow_heif
    from PIL import Image

    for k, view in enumerate(shipped[:2]):
        Image.fromarray(view).save(tmp_path / f"{k}.avif", quality=100)
        assert np.abs(read_picture(tmp_path / f"{k}.avif").gray.astype(int) - view).mean() < 1.0
        heif = pillow_heif.from_pillow(Image.fromarray(view))
        exif = Image.Exif()
        exif[0x0112] = 6 if turns else 1
        heif.save(tmp_path / f"{k}.heic", quality=-1, exif=exif.tobytes())
        assert np.abs(read_picture(tmp_path / f"{k}.heic").gray.astype(int) - view).mean() < 1.0
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    heic = tmp_path / "heic"
    heic.mkdir()
    shutil.move(tmp_path / "0.heic", heic)
    ended = calib("intrinsics", heic, "--rig", tmp_path / "rig.yaml")
    assert ended.code == 3
    assert (
        "0.heic: reading HEIC needs the package pillow-heif: pip install 'calib-rig[pictures]'"
        in ended.sentence
    )
    (tmp_path / "1.heic").write_bytes((tmp_path / "1.heic").read_bytes()[:400])
    with pytest.raises(Exception, match=r"1\.heic: (is not a picture|reading HEIC)"):
        read_picture(tmp_path / "1.heic")
