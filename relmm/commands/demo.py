"""The film of the demo: the same episode before and after learning, side by side.

python -m relmm.commands.demo FOLDER_BEFORE FOLDER_AFTER FILM
"""

from __future__ import annotations

import argparse
from pathlib import Path

from relmm.sim.film import beside

_EPISODE = Path("videos") / "eval_episode_0.mp4"


def main() -> None:
    """Join the first videos of two evaluations by relmm-eval."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="output folder of relmm-eval")
    parser.add_argument("after", type=Path, help="another one")
    parser.add_argument("film", type=Path, help="mp4 to write")
    arguments = parser.parse_args()
    films = {"before learning": arguments.before / _EPISODE, "after learning": arguments.after / _EPISODE}
    beside({f"{title}, at four times its speed": film for title, film in films.items()}, arguments.film)
    print(f"before and after: {arguments.film}")


if __name__ == "__main__":
    main()
