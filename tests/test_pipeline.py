"""What `mifit.fit` checks and says before and after its stages."""

from types import SimpleNamespace

import numpy as np
import pytest

from mifit.errors import InputError
from mifit.pipeline import check_images, one_place
from tests.output.conftest import ball_camera, ball_result


def capture_of(image, valid, clipped=False):
    frame = SimpleNamespace(image=image, valid=valid, clipped=np.full(valid.shape, clipped))
    return SimpleNamespace(frame=lambda name, timestep: frame)


def test_an_image_without_light_is_refused():
    image, valid = np.zeros((4, 5, 3), np.float32), np.ones((4, 5), bool)
    with pytest.raises(InputError, match="camera left, timestep 3: every usable pixel is black or clipped"):
        check_images(capture_of(image, valid), ["left"], [3])
    image[1, 2, 0] = 1e-4
    check_images(capture_of(image, valid), ["left"], [3])
    with pytest.raises(InputError, match="black"):
        check_images(capture_of(image, image[..., 0] == 0), ["left"], [3])
    with pytest.raises(InputError, match="clipped"):
        check_images(capture_of(image + 1, valid, clipped=True), ["left"], [3])


def test_views_from_one_place_bring_a_warning():
    cameras = {name: ball_camera(name, angle) for name, angle in (("a", 0.0), ("b", 1.0), ("c", 20.0), ("blind", 40.0))}
    capture = SimpleNamespace(
        camera=cameras.get, frame=lambda name, t: SimpleNamespace(visible=np.full(68, name != "blind"))
    )
    geometry = ball_result().geometry
    assert one_place(capture, ["a"], geometry)[0].startswith("landmarks in camera a alone: how far away")
    assert one_place(capture, ["a", "b"], geometry)[0].startswith("cameras 1.0 degrees apart")
    assert one_place(capture, ["blind", "c"], geometry)[0].startswith("landmarks in camera c alone")
    assert one_place(capture, ["a", "b", "c"], geometry) == ()
