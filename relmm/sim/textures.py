"""Pictures for floors and rugs, computed instead of shipped: each is a tile that repeats without a seam.

Every generator takes its randomness as an argument and returns RGB uint8, shape (size, size, 3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from relmm.errors import ConfigError

Image = NDArray[np.uint8]
FloatArray = NDArray[np.floating[Any]]
Generator = Callable[[np.random.Generator, int], Image]

MAX_SIZE = 512  # pixels a side; larger ones cost memory and nobody sees them on 100x100 camera pictures

# Colours are RGB, 0..255.
WOOD = (221.0, 204.0, 187.0)  # mean colour of the original floor
PLANK_ROWS = 8  # rows of planks in a tile: 125 mm wide on a tile of 1 m
PLANKS_IN_ROW = 2  # 500 mm long on a tile of 1 m
PLANK_CONTRAST = 7.0  # standard deviation of brightness from plank to plank
GRAIN_CONTRAST = 4.0  # and within a plank
CARPET = (150.0, 146.0, 140.0)
PLAIN = (205.0, 200.0, 192.0)
STRIPES = ((176.0, 84.0, 66.0), (232.0, 220.0, 198.0), (72.0, 96.0, 122.0), (232.0, 220.0, 198.0), (214.0, 164.0, 82.0))
MEDALLION = {
    "border": (44.0, 54.0, 92.0),
    "field": (150.0, 44.0, 46.0),
    "accent": (218.0, 188.0, 136.0),
}
CHECKS = ((222.0, 216.0, 204.0), (118.0, 138.0, 128.0))
SHAGGY = (206.0, 192.0, 176.0)

_GENERATORS: dict[str, Generator] = {}


def register_texture(name: str) -> Callable[[Generator], Generator]:
    """Decorator that makes a generator known under a name, for rooms to ask for."""

    def register(generator: Generator) -> Generator:
        if name in _GENERATORS:
            raise ConfigError(f"There already is a texture {name!r}; register yours under another name.")
        _GENERATORS[name] = generator
        return generator

    return register


def texture_names() -> list[str]:
    """Names of all known textures, sorted."""
    return sorted(_GENERATORS)


def check_texture(name: str) -> None:
    """Raise `ConfigError` unless `name` is a known texture."""
    if name not in _GENERATORS:
        raise ConfigError(f"There is no texture {name!r}; choose one of {', '.join(texture_names())}.")


def make_texture(name: str, rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """A texture by name.

    Args:
        name: one of `texture_names()`.
        rng: the only source of randomness.
        size: pixels a side, 32..512.

    Returns:
        RGB, uint8, shape (size, size, 3).

    Raises:
        ConfigError: unknown name, or a size out of range.
    """
    check_texture(name)
    if not 32 <= size <= MAX_SIZE:
        raise ConfigError(f"A texture of {size} pixels is not possible; choose 32 to {MAX_SIZE}.")
    return _GENERATORS[name](rng, size)


def add_material(
    spec: mujoco.MjSpec, name: str, texture: str, rng: np.random.Generator, size: int = MAX_SIZE
) -> mujoco.MjsMaterial:
    """Add a matt material that shows a texture, and the texture under the same name; arguments as `make_texture`."""
    image = make_texture(texture, rng, size)
    tile = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=size, height=size, nchannel=3)
    tile.data = image.tobytes()
    material = spec.add_material(name=name, specular=0.1, shininess=0.1, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return material


def _to_image(picture: FloatArray) -> Image:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _smooth(noise: FloatArray, radius: int, axis: int) -> FloatArray:
    """Moving average over 2 radius + 1 pixels that wraps around, scaled back to a standard deviation of 1."""
    kernel = np.zeros(noise.shape[axis])
    kernel[np.arange(-radius, radius + 1)] = 1.0
    shape = [1, 1]
    shape[axis] = -1
    spectrum = np.fft.fft(noise, axis=axis) * np.fft.fft(kernel).reshape(shape)
    smooth = np.fft.ifft(spectrum, axis=axis).real
    return np.asarray(smooth / smooth.std())


def _noise(rng: np.random.Generator, size: int, radius_y: int = 0, radius_x: int = 0) -> FloatArray:
    """Seamless noise of mean 0 and standard deviation 1, stretched along one axis or both; (size, size, 1)."""
    noise: FloatArray = rng.standard_normal((size, size))
    noise = _smooth(_smooth(noise, radius_y, axis=0), radius_x, axis=1)
    return np.asarray(noise - noise.mean())[..., None]


def _coordinates(size: int) -> tuple[FloatArray, FloatArray]:
    """Pixel centres as (x, y) in -1..1, each of shape (size, size)."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis, axis)
    return x, y


@register_texture("wood")
def wood(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """Light parquet: staggered planks with grain along them and thin dark joints."""
    y, x = np.mgrid[0:size, 0:size] / size
    row = (y * PLANK_ROWS).astype(int)
    along = x * PLANKS_IN_ROW + rng.random(PLANK_ROWS)[row]
    plank = along.astype(int) % PLANKS_IN_ROW

    shade = rng.standard_normal((PLANK_ROWS, PLANKS_IN_ROW))
    # Standardised, so that the tile has the same mean colour whatever the seed.
    shade = (shade - shade.mean()) * (PLANK_CONTRAST / shade.std())
    grain = GRAIN_CONTRAST * (_noise(rng, size, 0, size // 16) + 0.6 * _noise(rng, size, 2, size // 5))

    # The joints are one or two pixels wide: 2 to 4 mm on a tile of 1 m.
    across_joint = (y * PLANK_ROWS) % 1.0 < 1.5 * PLANK_ROWS / size
    along_joint = along % 1.0 < 1.5 * PLANKS_IN_ROW / size
    joint = 26.0 * (across_joint | along_joint)
    brightness = shade[row, plank][..., None] + grain - (joint - joint.mean())[..., None]
    return _to_image(np.asarray(WOOD) + brightness * np.array([1.0, 1.03, 1.1]))


@register_texture("carpet")
def carpet(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """Grey wall-to-wall carpet: fine speckles with faint clouds."""
    return _to_image(
        np.asarray(CARPET) + 9.0 * _noise(rng, size, 1, 1) + 3.0 * _noise(rng, size, size // 16, size // 16)
    )


@register_texture("plain")
def plain(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """One light colour with hardly any noise, like painted screed."""
    return _to_image(np.asarray(PLAIN) + 1.5 * _noise(rng, size, 1, 1))


@register_texture("rug_stripes")
def rug_stripes(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """Woven stripes of different widths and colours."""
    widths = rng.uniform(0.5, 1.5, 2 * len(STRIPES))
    edges = np.cumsum(widths) / widths.sum()
    stripe = np.searchsorted(edges[:-1], (np.arange(size) + 0.5) / size) % len(STRIPES)
    colors = np.asarray(STRIPES)[stripe][:, None]
    return _to_image(colors + 6.0 * _noise(rng, size, 0, 2))


@register_texture("rug_medallion")
def rug_medallion(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """An oriental rug: borders, a field with a lattice of small flowers and a scalloped medallion."""
    x, y = _coordinates(size)
    border, field, accent = (np.asarray(MEDALLION[key]) for key in ("border", "field", "accent"))
    edge = np.maximum(np.abs(x), np.abs(y))
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    scalloped = radius * (1 + 0.08 * np.cos(12 * angle))
    flowers = np.sin(9 * np.pi * x) * np.sin(9 * np.pi * y) > 0.75

    picture = np.broadcast_to(field, (size, size, 3)).copy()
    picture[flowers] = accent
    for outer, color in ((0.52, accent), (0.48, border), (0.32, accent), (0.28, field), (0.12, accent)):
        picture[scalloped < outer] = color
    picture[edge > 0.72] = border
    picture[(edge > 0.72) & (np.sin(14 * np.pi * x) * np.sin(14 * np.pi * y) > 0.4)] = accent
    for inner, outer in ((0.70, 0.73), (0.91, 0.94)):
        picture[(edge > inner) & (edge < outer)] = accent
    return _to_image(picture + 6.0 * _noise(rng, size, 1, 1))


@register_texture("rug_checks")
def rug_checks(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """Checks of two colours in a basket weave."""
    y, x = np.mgrid[0:size, 0:size]
    dark = ((x * 8 // size) + (y * 8 // size)) % 2
    thread = np.where(dark == 1, np.sin(x * 2 * np.pi * 64 / size), np.sin(y * 2 * np.pi * 64 / size))
    return _to_image(np.asarray(CHECKS)[dark] + 10.0 * thread[..., None] + 5.0 * _noise(rng, size, 1, 1))


@register_texture("rug_shaggy")
def rug_shaggy(rng: np.random.Generator, size: int = MAX_SIZE) -> Image:
    """Deep pile in one colour: tufts of light and shade."""
    tufts = 9.0 * _noise(rng, size, size // 64, size // 128) + 6.0 * _noise(rng, size, 1, 1)
    return _to_image(np.asarray(SHAGGY) + tufts)
