"""What navigation sees: pictures as in the paper, or a map of the floor with the grasp ensemble's opinion of it."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from relmm.features import GRASP_X, GRASP_Y, GRID, IMAGE_SIZE
from relmm.geometry import camera_geometry
from relmm.policies.relmm.configuration_relmm import ReLMMConfig
from relmm.policies.relmm.floor import FloorView
from relmm.policies.relmm.grasping import GraspEnsemble, RectifiedBackbone

# A pixel of the navigation map is 7x7 grasp cells, 7.7 cm. The map reaches 2.4 m ahead and 1.2 m to either side: as
# far as a grown ensemble recognises what it has learned at arm's length.
_CELLS = 7
_ROWS, _COLUMNS = 30, 31
_NEAR_ROWS = 1  # pixels of the map before the grasp area
_PLACES = 8  # of a picture that teach what no attempt has shown, where nobody will try them
_BANDS = 3  # strips across the map, each as wide as the camera sees the floor there
NOTICED = 64  # of 255, graspability from which on something is in view
_HEADS = 8
_INITIAL_ATTENTION = 6.0  # score of a certain grasp; -6 for a hopeless one
_POINT_FEATURES = 256
_CONVOLUTION_FEATURES = 128


def map_places() -> Tensor:
    """Where the map's pixels are in the robot's frame: forward and left, m, (2, 30, 31)."""
    forward, left = (_CELLS * (high - low) / GRID for low, high in (GRASP_X, GRASP_Y))  # m, a pixel
    rows = GRASP_X[0] + (torch.arange(_ROWS) - _NEAR_ROWS + 0.5) * forward
    columns = (torch.arange(_COLUMNS) - _COLUMNS // 2) * left
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"))


class PictureObserver(nn.Module):
    """The paper's observation: the picture itself."""

    shape = (3, IMAGE_SIZE, IMAGE_SIZE)

    def forward(self, images: Tensor, grasping: GraspEnsemble) -> Tensor:
        """Pictures 0..1 as uint8, (batch, 3, 100, 100); the ensemble is not asked."""
        return (images * 255).round().to(torch.uint8)


class FloorObserver(nn.Module):
    """A map of the floor: where a grasp would succeed, and its colours.

    The ensemble is fully convolutional, so it can judge floor that the arm does not reach yet: navigation gets a map of
    graspable things that was learned from grasps alone.

    Args:
        config: of the policy.
    """

    shape = (4, _ROWS, _COLUMNS)

    def __init__(self, config: ReLMMConfig) -> None:
        super().__init__()
        camera = camera_geometry(config.camera)
        row, column = -_NEAR_ROWS * _CELLS, -(_COLUMNS * _CELLS - GRID) // 2
        margin = 4  # cells that the networks see around one
        rows, columns = _ROWS * _CELLS, _COLUMNS * _CELLS
        self._margin = margin
        self.view = FloorView(camera, row - margin, column - margin, rows + 2 * margin, columns + 2 * margin)
        # A cell is judged by the floor round it; the picture's edge looks like an object where no grasp has taught
        # otherwise, that is, outside the grasp area.
        outside = (self.view.grid.abs() > 1).any(dim=-1)
        known = functional.max_pool2d(outside.float()[None], 2 * margin + 1, stride=1)[0] == 0
        known[-row : GRID - row, -column : GRID - column] = ~outside[margin - row :, margin - column :][:GRID, :GRID]
        self.known: Tensor
        self.register_buffer("known", known, persistent=False)
        beyond = known.clone()
        beyond[: GRID - row] = False
        self._places: tuple[Tensor, Tensor] = known.nonzero(), beyond.nonzero()  # (n, 2)
        strips = [(first, first + rows // _BANDS) for first in range(0, rows, rows // _BANDS)]
        self._bands = [_rectangle(known, *strip) for strip in strips if known[slice(*strip)].any()]

    @torch.no_grad()
    def forward(self, images: Tensor, grasping: GraspEnsemble) -> Tensor:
        """Grasp probability (the highest in each pixel) and RGB (their mean), uint8, (batch, 4, 30, 31)."""
        assert isinstance(grasping.backbone, RectifiedBackbone)
        floor, margin = self.view(images), self._margin
        chances = floor.new_zeros(len(images), *self.known.shape)
        for rows, columns in self._bands:
            band = floor[:, :, rows.start : rows.stop + 2 * margin, columns.start : columns.stop + 2 * margin]
            chances[:, rows, columns] = grasping.backbone.first_on_map(band).sigmoid()
        graspable = functional.max_pool2d(chances * self.known, _CELLS)
        colours = functional.avg_pool2d(floor[:, :, margin:-margin, margin:-margin], _CELLS) / 2 + 0.5
        return (torch.cat([graspable[:, None], colours], dim=1) * 255).round().to(torch.uint8)

    def background_loss(
        self, images: Tensor, grasping: GraspEnsemble, rng: torch.Generator, offline: bool = False
    ) -> Tensor:
        """How graspable a random place in each picture seems, the mean over pictures; summed over the members.

        No attempt is ever made at walls or furniture, so the network that draws the map would answer there as it
        pleases. Nearly all places are empty; the few that are not look like what attempts have taught. This loss lets
        them be (Ghosh et al. 2017: with wrong labels, the absolute error): cross-entropy would teach, for as long as
        it is learned, that what is far is no thing to grasp. A robot that learns while it acts finds out about what is
        in reach, so a place beyond it is enough, and the map's member. `offline`, who recorded the data may never have
        failed, and all members learn from several places anywhere, each as much as that one.
        """
        assert isinstance(grasping.backbone, RectifiedBackbone)
        everywhere, beyond = self._places
        places = everywhere if offline else beyond
        if offline:
            images = images.repeat_interleave(_PLACES, dim=0)
        chosen = places[torch.randint(len(places), (len(images),), generator=rng)].to(images.device)
        rows, columns = chosen[:, :, None].unbind(1)
        patch = torch.arange(2 * self._margin + 1, device=images.device)
        grid = self.view.grid[(rows + patch)[:, :, None], (columns + patch)[:, None, :]]
        logits = grasping.backbone.on_map(self.view.at(images, grid), members=None if offline else 1)
        return logits.sigmoid().flatten(1).mean(dim=1).sum() * (_PLACES if offline else 1)


def _rectangle(known: Tensor, first: int, last: int) -> tuple[slice, slice]:
    """Rows and columns of what is known in a strip of the map."""
    columns = known[first:last].any(dim=0).nonzero()
    return slice(first, last), slice(int(columns.min()), int(columns.max()) + 1)


def make_observer(config: ReLMMConfig) -> PictureObserver | FloorObserver:
    """What turns pictures into the observations of `config.navigation_encoder`."""
    return FloorObserver(config) if config.navigation_encoder == "floor" else PictureObserver()


class Keypoints(nn.Module):
    """A few points of the map that matter, by soft attention: where each is, and how graspable.

    Convolutions need many updates to learn positions (Levine et al. 2016 hence take a spatial softmax). Attention looks
    at first at the graspable thing that is nearest to the grasp area, and learns from there.
    """

    features = 3 * _HEADS

    def __init__(self) -> None:
        super().__init__()
        self.places: Tensor
        middle = torch.tensor([[sum(GRASP_X) / 2], [sum(GRASP_Y) / 2]])
        self.register_buffer("places", map_places().flatten(1) - middle, persistent=False)
        self.look = nn.Linear(FloorObserver.shape[0], _HEADS, bias=False)
        with torch.no_grad():
            self.look.weight.mul_(0.1)
            self.look.weight[:, 0] = _INITIAL_ATTENTION
        reach = torch.logspace(-1, 0, _HEADS)[:, None]  # m, how far each head looks before it prefers the nearer
        self.prefer = nn.Parameter(-self.places.norm(dim=0) / reach)

    def forward(self, maps: Tensor) -> Tensor:
        """Maps in -1..1, (batch, 4, 30, 31) -> x and y in m and graspability of each point, (batch, 3 * heads)."""
        maps, count = maps.flatten(2), len(maps)
        look, prefer = self.look.weight.expand(count, -1, -1), self.prefer.expand(count, -1, -1)
        attention = torch.baddbmm(prefer, look, maps).softmax(dim=-1)
        values = torch.cat([self.places.expand(count, -1, -1), maps[:, :1]], dim=1)
        return torch.bmm(attention, values.transpose(1, 2)).flatten(1)


class Encoder(nn.Module):
    """Features of a navigation observation: convolutions; for a map of the floor also keypoints.

    Args:
        kind: as in `ReLMMConfig.navigation_encoder`.

    Attributes:
        features: length of the output.
    """

    def __init__(self, kind: str) -> None:
        super().__init__()
        shape = FloorObserver.shape if kind == "floor" else PictureObserver.shape
        self.layers = nn.Sequential(*_LAYERS[kind](), nn.Flatten())
        self.on_floor = kind == "floor"
        if self.on_floor:
            self.keypoints = Keypoints()
            self.embed = nn.Sequential(nn.Linear(Keypoints.features, _POINT_FEATURES), nn.ReLU(inplace=True))
        with torch.no_grad():
            self.features: int = self(torch.zeros(1, *shape)).shape[1]

    def forward(self, observations: Tensor) -> Tensor:
        """Features, (batch, features), of uint8 observations, (batch, channels, height, width)."""
        scaled = observations.float() / 127.5 - 1
        encoded: Tensor = self.layers(scaled.contiguous(memory_format=torch.channels_last))
        return torch.cat([encoded, self.embed(self.keypoints(scaled))], dim=1) if self.on_floor else encoded


def _paper_layers() -> list[nn.Module]:
    """Three convolutions of stride 1 with average pooling after each, as in the authors' code (the paper: between)."""
    return [
        layer for inputs in (3, 64, 64) for layer in (nn.Conv2d(inputs, 64, 3, padding=1), nn.ReLU(), nn.AvgPool2d(2))
    ]


def _paper_small_layers() -> list[nn.Module]:
    """The same with 32 channels and stride 2 in place of pooling: a hundredth of the arithmetic."""
    return [layer for inputs in (3, 32, 32) for layer in (nn.Conv2d(inputs, 32, 3, stride=2, padding=1), nn.ReLU())]


def _floor_layers() -> list[nn.Module]:
    widths = (FloorObserver.shape[0], 16, 32, 32)
    convolutions = [
        layer
        for inputs, outputs in pairwise(widths)
        for layer in (nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ReLU(inplace=True))
    ]
    pixels = widths[-1] * math.ceil(_ROWS / 8) * math.ceil(_COLUMNS / 8)
    features = _CONVOLUTION_FEATURES
    return [*convolutions, nn.Flatten(), nn.Linear(pixels, features), nn.LayerNorm(features), nn.ReLU(inplace=True)]


_LAYERS: dict[str, Any] = {"paper": _paper_layers, "paper_small": _paper_small_layers, "floor": _floor_layers}
