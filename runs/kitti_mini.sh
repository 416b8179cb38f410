#!/usr/bin/env bash
# How the released family `kitti-mini` was made, from labelled scans and camera images to the files in the package:
#   runs/kitti_mini.sh DATA OUT
# DATA is a data set in SemanticKITTI's layout with camera_labels/ and splits.json (README, "Training and scoring").
# Every stage resumes: run the same command again after an interruption. Minutes are those of two CPU cores that were busy
# with other things as well; more of them make better weights.
set -euo pipefail
data=$1 out=$2

# The segmenter in two stages: all directions alike and rare classes weighed heavily, then as streets lie.
lidar2pano train salsanext-mini --data "$data" --out "$out/first" --set training.minutes=22 \
  --set options.turn_deg=180 --set options.rarity=0.5
lidar2pano train salsanext-mini --data "$data" --out "$out/segmenter" --set training.minutes=23 \
  --set "networks.segmenter.start=$out/first/weights/segmenter.last.safetensors" \
  --set networks.segmenter.optimizer.rate=0.002
labels="options.segmenter=$out/segmenter/weights/segmenter.safetensors"

lidar2pano train titan-pano-mini --data "$data" --out "$out/translator" --set training.minutes=22 --set "$labels"
seen="options.translator=$out/translator/weights/translator.safetensors"

# The painter in two stages: colours alone, then with a critic.
lidar2pano train painter-mini --data "$data" --out "$out/colours" --set training.minutes=4 --set "$labels" --set "$seen" \
  --set options.adversarial=0 --set options.features=0 --set options.pixels=10 \
  --set networks.painter.optimizer.rate=0.002 --set networks.painter.optimizer.betas=0.9,0.99
lidar2pano train painter-mini --data "$data" --out "$out/painter" --set training.minutes=14 --set "$labels" --set "$seen" \
  --set options.adversarial=0.5 --set options.features=5 --set options.pixels=1 --set training.ema=0.99 \
  --set "networks.painter.start=$out/colours/weights/painter.safetensors" --set networks.painter.optimizer.rate=0.0006

# TITAN-Net the paper's way, to be scored beside the family.
lidar2pano train titan-mini --data "$data" --out "$out/titan" --set training.minutes=7.5 --set "$labels"

mkdir -p "$out/family"
for role in segmenter translator painter; do cp "$out/$role/weights/$role.safetensors" "$out/family"; done
lidar2pano evaluate "$out/family" "$out/titan" --data "$data" --split val --json "$out/val.json"
python "$(dirname "$0")/release_family.py" "$out/family" kitti-mini "$out/val.json" --licence CC-BY-NC-SA-4.0
