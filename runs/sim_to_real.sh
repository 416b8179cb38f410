#!/usr/bin/env bash
# SalsaNext trained on the street world alone, scored on real scans:
#   runs/sim_to_real.sh KITTI OUT [SEQUENCES] [MINUTES]
# KITTI is a data set with splits `labelled` (ground truth) and `val`. Every stage resumes.
set -euo pipefail
kitti=$1 out=$2 sequences=${3:-60} minutes=${4:-20}
lidar2pano world "$out/world" --sequences "$sequences" --frames 4 --hz 0.5 --seed 1 --save scans
lidar2pano train salsanext-mini --data "$out/world" --out "$out/run" --set training.minutes="$minutes" \
  --set data.train=train,val --set options.rotation_deg=180 --set options.dropout=false --set training.validate_minutes=0
for split in labelled val; do
  lidar2pano evaluate "$out/run" --data "$kitti" --split "$split" --json "$out/$split.json" | grep 'points:'
done
