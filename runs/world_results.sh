#!/usr/bin/env bash
# Write docs/world.md, docs/world.jpg and docs/lidar.png: the street world beside real scans.
#   runs/world_results.sh KITTI WORLD SIM_TO_REAL
# KITTI is a real data set, WORLD a simulated one with everything (lidar2pano world WORLD --sequences 12 --frames 1 --seed 2),
# SIM_TO_REAL the folder that runs/sim_to_real.sh wrote.
set -euo pipefail
kitti=$1 world=$2 real=$3
cd "$(dirname "$0")/.."
python runs/world_sheet.py "$world" docs/world.jpg
{
  echo '# The street world'
  echo
  echo 'Written by `runs/world_results.sh`; nothing here is typed.'
  echo
  echo '![Twelve frames: image, classes, range](world.jpg)'
  echo
  echo '## Points, images and depths of one frame agree (`runs/check_world.py`)'
  echo
  python runs/check_world.py "$world"
  echo
  echo '## Simulated beside real scans (`runs/lidar_comparison.py`)'
  echo
  echo '![Simulated and real scans](lidar.png)'
  echo
  python runs/lidar_comparison.py "$real/world" "$kitti" docs/lidar.png
  echo
  python runs/class_shares.py "$real/world" "$kitti"
  echo
  echo '## From the street world to real scans (`runs/sim_to_real.sh`)'
  echo
  echo 'SalsaNext trained on simulated scans alone, by its 19 classes (those that occur):'
  for split in labelled val; do
    echo
    python - "$real/$split.json" <<'PY'
import json
import sys

found = json.load(open(sys.argv[1]))
result = found["results"][0]
score, made = result["score"]["segmenter"], result["networks"]["segmenter"]
print(f"`{found['split']}` ({found['scans']} scans): **mIoU {score['point_miou']:.3f}**, accuracy {score['point_accuracy']:.3f};")
print(f"{made['recipe']}, {made['steps']} steps, {made['hours']} h, commit {made['commit'][:12]}.")
PY
  done
  echo
  echo '## Times (`lidar2pano bench --world`)'
  echo
  lidar2pano bench --world --runs 5
} >docs/world.md.new
mv docs/world.md.new docs/world.md
