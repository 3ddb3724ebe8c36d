"""The moving picture at the top of the README: `make demo`'s film, smaller and faster.

python benchmarks/readme_film.py outputs/demo/DATE/before_and_after.mp4 docs/demo.webp
"""

from __future__ import annotations

import argparse
from pathlib import Path

import av
from PIL import Image

WIDTH, EVERY, FPS = 880, 6, 10  # pixels; pictures of the film of which one is taken; of those, a second


def main() -> None:
    """Read an mp4, write a WebP."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("film", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    with av.open(str(arguments.film)) as film:
        frames = [frame.to_image() for frame in film.decode(video=0)][::EVERY]
    small = [frame.resize((WIDTH, WIDTH * frame.height // frame.width), Image.Resampling.LANCZOS) for frame in frames]
    small[0].save(
        arguments.output, save_all=True, append_images=small[1:], duration=1000 // FPS, loop=0, quality=50, method=4
    )
    print(f"{arguments.output}: {len(small)} pictures, {arguments.output.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
