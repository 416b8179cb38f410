#!/usr/bin/env bash
# TITAN-Net, its ablations and Pix2Pix on a street world, each for as many steps; writes docs/reproduce.md:
#   runs/reproduce_world.sh OUT [STEPS] [ROWS]
# Takes some two hours of two CPU cores for 1000 steps. Training resumes: repeat the command.
set -euo pipefail
out=$1 steps=${2:-1000} rows=${3:-titan,pix2pix,titan-no-lovasz,titan-no-range,titan-no-segments}
cd "$(dirname "$0")/.."
lidar2pano world "$out/world" --sequences 24 --frames 10 --hz 1 --seed 7001 --save scans,camera
python - "$out/world/splits.json" <<'PY'
import json
import sys

listing = json.load(open(sys.argv[1]))  # six towns for scoring
val = [frame for frame in listing["all"] if int(frame[:2]) >= 18]
listing |= {"val": val, "train": [frame for frame in listing["all"] if frame not in val]}
json.dump(listing, open(sys.argv[1], "w"), indent=1)
PY
runs/reproduce_rows.sh "$out/world" "$out/tables" "$steps" "$rows" reproduce
