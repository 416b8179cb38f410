#!/usr/bin/env bash
# The paper's tables on a small street world, every network with the same small budget; writes docs/reproduce.md:
#   runs/reproduce_world.sh OUT [BUDGET] [SEGMENTER]
# SEGMENTER are weights of a LiDAR segmenter (a run of runs/sim_to_real.sh); without them one is trained like the others.
set -euo pipefail
out=$1 budget=${2:-90s} segmenter=${3:-}
cd "$(dirname "$0")/.."
lidar2pano world "$out/world" --sequences 10 --frames 6 --hz 5 --seed 11
python - "$out/world/splits.json" <<'PY'
import json
import sys

listing = json.load(open(sys.argv[1]))  # two streets for scoring, not one
val = [frame for frame in listing["all"] if frame[:2] in ("08", "09")]
listing |= {"val": val, "train": [frame for frame in listing["all"] if frame not in val]}
json.dump(listing, open(sys.argv[1], "w"), indent=1)
PY
lidar2pano reproduce --data "$out/world" --out "$out/tables" --budget "$budget" --frames 6 ${segmenter:+--segmenter "$segmenter"}
runs/reproduce_docs.py "$out/tables"
