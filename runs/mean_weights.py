"""The mean of weight files of one network that come from one start: often better than each (Wortsman et al. 2022).

    python runs/mean_weights.py OUT FILE FILE... [--shares 0.5,0.5]

Norms' running statistics are averaged like everything else. The card is the last file's; its recipe says so.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from lidar2pano.models.card import load, save


def main() -> None:
    """Read the arguments and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--shares", default="")
    arguments = parser.parse_args()
    count = len(arguments.files)
    shares = [float(share) for share in arguments.shares.split(",") if share] or [1 / count] * count
    if len(shares) != count or abs(sum(shares) - 1) > 1e-6:
        parser.error("--shares must be as many as files, and 1 together")
    loaded = [load(file) for file in arguments.files]
    network, card = loaded[-1]
    states = [one.state_dict() for one, _ in loaded]
    mean = {name: value for name, value in states[-1].items() if not value.is_floating_point()}  # norms' counters
    for name in states[-1].keys() - mean.keys():
        mean[name] = sum(share * state[name] for share, state in zip(shares, states, strict=True))
    network.load_state_dict(mean)
    parts = " and ".join(f"{share:g} x {one.recipe}" for share, (_, one) in zip(shares, loaded, strict=True))
    save(arguments.out, network, replace(card, recipe=f"mean of {parts}"))


if __name__ == "__main__":
    main()
