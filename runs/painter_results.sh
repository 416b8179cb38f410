#!/usr/bin/env bash
# Write docs/scene_painter.md: a family with a new painter beside one with the former painter, on real frames.
#   runs/painter_results.sh KITTI FORMER
# KITTI has the split val; FORMER is a folder with the family's weights and the former painter, made by
#   mkdir FORMER && for file in segmenter translator painter; do
#     git show COMMIT:src/lidar2pano/weights/kitti-mini/$file.safetensors >FORMER/$file.safetensors; done
set -euo pipefail
kitti=$(realpath "$1") former=$(realpath "$2")
page=$(realpath "$(dirname "$0")/../docs/scene_painter.md")
cd "$(dirname "$former")"
{
  echo '# The scene painter beside the painter before it'
  echo
  echo 'Written by `runs/painter_results.sh`; not edited by hand. Classes and depth are the same in both: only the painter differs.'
  echo
  lidar2pano evaluate "$(basename "$former")" kitti-mini --data "$kitti" --split val --metrics pictures,camera
} >"$page.new"
mv "$page.new" "$page"
