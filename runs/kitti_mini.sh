#!/usr/bin/env bash
# How the released family `kitti-mini` was made, from labelled scans and camera images to the files in the package:
#   runs/kitti_mini.sh DATA OUT [SEGMENTER_MINUTES TRANSLATOR_MINUTES PAINTER_MINUTES]
# DATA is a data set in SemanticKITTI's layout with camera_labels/ and splits.json (README, "Training and scoring").
# Every stage resumes: run the same command again after an interruption. `compare` trains TITAN-Net the paper's way on
# the same data for as long as the translator, to be scored beside it.
set -euo pipefail
data=$1 out=$2
segmenter=${3:-22} translator=${4:-27} painter=${5:-30}

lidar2pano train salsanext-mini --data "$data" --out "$out/segmenter" --set "training.minutes=$segmenter"
labels="options.segmenter=$out/segmenter/weights/segmenter.safetensors"

lidar2pano train titan-pano-mini --data "$data" --out "$out/translator" \
  --set "training.minutes=$translator" --set "$labels"

lidar2pano train painter-mini --data "$data" --out "$out/painter" \
  --set "training.minutes=$painter" --set "$labels" \
  --set "options.translator=$out/translator/weights/translator.safetensors"

lidar2pano train titan-mini --data "$data" --out "$out/compare" --set "training.minutes=$translator" --set "$labels"

lidar2pano evaluate "$out/translator" "$out/compare" --data "$data" --split val
