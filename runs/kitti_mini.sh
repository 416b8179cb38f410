#!/usr/bin/env bash
# How the family `kitti-mini` began, from labelled scans and camera images; runs/release.sh goes on from here:
#   runs/kitti_mini.sh DATA OUT
# DATA is a data set in SemanticKITTI's layout with camera_labels/ and splits.json (README, "Training and scoring").
# Every stage resumes: run the same command again after an interruption. Minutes are those of two CPU cores that were busy
# with other things as well; more of them make better weights.
set -euo pipefail
data=$1 out=$2
weights() { echo "$out/$1/weights/$2.safetensors"; }

# The segmenter: all directions alike and rare classes weighed heavily; then as streets lie; then without dropout.
lidar2pano train salsanext-mini --data "$data" --out "$out/segmenter-1" --set training.minutes=22 \
  --set options.rotation_deg=180 --set options.class_weight_exponent=0.5
lidar2pano train salsanext-mini --data "$data" --out "$out/segmenter-2" --set training.minutes=23 \
  --set "networks.segmenter.start=$(weights segmenter-1 segmenter.last)" --set networks.segmenter.optimizer.rate=0.002
lidar2pano train salsanext-mini --data "$data" --out "$out/segmenter-3" --set training.minutes=42 \
  --set "networks.segmenter.start=$(weights segmenter-2 segmenter)" --set networks.segmenter.optimizer.rate=0.002 \
  --set options.dropout=false --set options.augment_probability=0.2 --set training.validate_minutes=14
first="options.segmenter=$(weights segmenter-2 segmenter)" labels="options.segmenter=$(weights segmenter-3 segmenter)"

# The translator: on the second segmenter's labels, then on the third's; half of its class weights are taken back.
lidar2pano train titan-pano-mini --data "$data" --out "$out/translator-1" --set training.minutes=22 --set "$first"
lidar2pano train titan-pano-mini --data "$data" --out "$out/translator-2" --set training.minutes=33 --set "$labels" \
  --set "networks.translator.start=$(weights translator-1 translator)" --set networks.translator.optimizer.rate=0.0015 \
  --set options.lovasz=1.5 --set training.validate_minutes=11
mkdir -p "$out/family"
python "$(dirname "$0")/prior.py" "$(weights translator-2 translator)" "$out/family/translator.safetensors" \
  --data "$data" --share 0.5
# A third stage scored no better and is not released.
lidar2pano train titan-pano-mini --data "$data" --out "$out/translator-3" --set training.minutes=10 --set "$labels" \
  --set "networks.translator.start=$(weights translator-2 translator)" --set networks.translator.optimizer.rate=0.0007 \
  --set options.lovasz=1.5 --set options.class_weight_exponent=0.25 --set training.validate_minutes=5

# TITAN-Net the paper's way and ours for as many minutes, to be scored beside the family.
# RESULTS.md's titan-7min was trained before titan-mini got half the picture, a narrower critic and a heavier guide.
lidar2pano train titan-mini --data "$data" --out "$out/titan-7min" --set training.minutes=7.5 --set "$first"
lidar2pano train titan-pano-mini --data "$data" --out "$out/titan-pano-7min" --set training.minutes=7.5 --set "$first"

cp "$(weights segmenter-3 segmenter)" "$out/family"
lidar2pano evaluate "$out/family" "$out/titan-pano-7min" "$out/titan-7min" --data "$data" --split val --json "$out/val.json"
