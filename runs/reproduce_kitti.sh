#!/usr/bin/env bash
# TITAN-Net, its ablations and Pix2Pix on kitti-mini, each for as many steps; writes docs/reproduce_kitti.md:
#   runs/reproduce_kitti.sh KITTI_MINI OUT [STEPS] [ROWS]
# Takes some two and a half hours of two CPU cores for 1000 steps. Training resumes: repeat the command.
# 52 images are scored: `val`, the drive, and the second half of the stereo images, so that orderings can be decided.
# Point labels are those of the family world, whose segmenter has seen no real scan.
set -euo pipefail
data=$(realpath "$1") out=$2 steps=${3:-1000} rows=${4:-titan,pix2pix,titan-no-lovasz,titan-no-range,titan-no-segments}
cd "$(dirname "$0")/.."
mkdir -p "$out/kitti-mini"
ln -sfn "$data/sequences" "$out/kitti-mini/sequences"
python - "$data/splits.json" "$out/kitti-mini/splits.json" <<'PY'
import json
import sys

listing = json.load(open(sys.argv[1]))
later = [frame for frame in listing["train"] if frame.startswith("stereo/")][20:]
scored = listing["val"] + listing["drive"] + later
train = [frame for frame in listing["train"] if frame not in scored]
train.sort(key=lambda frame: frame.startswith("0928/"))  # the last sequence, two frames, becomes the split `selection`
json.dump({"train": train, "val": scored}, open(sys.argv[2], "w"), indent=1)
PY
runs/reproduce_rows.sh "$out/kitti-mini" "$out/tables" "$steps" "$rows" reproduce_kitti
