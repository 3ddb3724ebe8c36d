"""Pictures in pieces, for phones."""

import re

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

from relmm.analysis.drawing import draw
from relmm.analysis.figures import STYLE


def panels(count: int, width: float) -> Figure:
    """Panels with a colorbar each."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, 3), layout="constrained")
        for ax in figure.subplots(1, count, squeeze=False)[0]:
            ax.set(ylabel="forward, cm")
            figure.colorbar(ax.imshow([[0, 1]], aspect="auto"), ax=ax)
    return figure


@pytest.mark.parametrize(("count", "width", "pieces"), [(3, 9, 3), (4, 8, 2), (1, 9, 0), (2, 4, 0)])
def test_pieces_are_whole_panels_that_a_phone_can_show(count, width, pieces):
    figure = panels(count, width)
    drawn = draw(figure, "made", None)
    assert len(drawn.pieces) == pieces
    ends = [piece.left + piece.width for piece in drawn.pieces]
    assert [piece.left for piece in drawn.pieces] == pytest.approx([0.0, *ends[:-1]][: len(ends)])
    assert all(end == pytest.approx(72 * width) for end in ends[-1:])
    assert all(piece.width <= 72 * 4.5 for piece in drawn.pieces)
    for axes in figure.axes:  # none is cut in two, nor are its labels
        box = axes.get_tightbbox().transformed(figure.dpi_scale_trans.inverted())
        for end in ends[:-1]:
            assert not box.x0 * 72 < end < box.x1 * 72


def test_pieces_refer_to_what_is_drawn_and_no_two_pictures_share_a_name():
    one, other = (draw(panels(2, 8), name, None) for name in ("one", "other"))
    names = [set(re.findall(r'id="([^"]+)"', drawn.svg)) for drawn in (one, other)]
    assert one.content in names[0]
    assert other.content in names[1]
    assert not names[0] & names[1]
    for drawn, known in zip((one, other), names, strict=True):
        assert set(re.findall(r'(?:xlink:href="#|url\(#)([^")]+)', drawn.svg)) <= known


def test_files_are_written_only_where_they_are_wanted(tmp_path):
    draw(panels(1, 4), "made", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"made.png", "made.svg"}
