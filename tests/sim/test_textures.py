import numpy as np
import pytest

from relmm.errors import ConfigError
from relmm.sim.textures import WOOD, make_texture, register_texture, texture_names


@pytest.mark.parametrize("name", texture_names())
def test_shape_type_and_determinism(name: str) -> None:
    first, again, other = (make_texture(name, np.random.default_rng(seed), 128) for seed in (3, 3, 4))
    assert first.shape == (128, 128, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert 40 < first.mean() < 230  # neither black nor white, so that objects of either colour stand out


@pytest.mark.parametrize("seed", range(3))
def test_wood_has_the_original_floors_mean_colour_and_little_contrast(seed: int) -> None:
    picture = make_texture("wood", np.random.default_rng(seed), 512)
    assert np.allclose(picture.mean((0, 1)), WOOD, atol=1)
    assert 5 < picture.std(axis=(0, 1)).mean() < 20


def test_rugs_come_in_four_patterns() -> None:
    assert len([name for name in texture_names() if name.startswith("rug_")]) >= 4


@pytest.mark.parametrize("name", ["wood", "carpet", "rug_shaggy"])
def test_tiles_repeat_without_a_seam(name: str) -> None:
    picture = make_texture(name, np.random.default_rng(0), 256).astype(float)
    for axis in (0, 1):
        steps = np.abs(np.diff(picture, axis=axis)).mean(axis=(1 - axis, 2))
        seam = np.abs(picture.take(0, axis) - picture.take(-1, axis)).mean()
        assert seam <= steps.max() * 1.05


def test_unknown_name_and_size_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ConfigError, match=r"no texture 'marble'; choose one of .*wood"):
        make_texture("marble", rng)
    with pytest.raises(ConfigError, match="1024 pixels"):
        make_texture("wood", rng, 1024)


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ConfigError, match="already is a texture 'wood'"):
        register_texture("wood")(lambda rng, size: np.zeros((size, size, 3), np.uint8))
