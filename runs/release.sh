#!/usr/bin/env bash
# The released families, from a seed to the files in the package:
#   runs/release.sh KITTI OUT
# KITTI is a data set in SemanticKITTI's layout with camera_labels/ and the splits train, val and labelled. Every stage
# resumes: run the same command again after an interruption, in slices as short as a machine allows.
#   FORM=        the recipes' full size, for a GPU (default -mini: two CPU cores)
#   MINUTES=1.5  each stage takes so many times as long (default 1: the minutes of the released files)
#   TOWNS=1000   how many towns are simulated (default 60)
set -euo pipefail
kitti=$1 out=$2
form=${FORM--mini} longer=${MINUTES:-1} towns=${TOWNS:-60}
here=$(dirname "$0")
weights() { echo "$out/$1/weights/$2.safetensors"; }
stage() { # RUN RECIPE DATA MINUTES [OVERRIDE...]
  local run=$1 recipe=$2 data=$3 minutes set=()
  minutes=$(python -c "print($4 * $longer)")
  shift 4
  for each in "$@"; do set+=(--set "$each"); done
  lidar2pano train "$recipe$form" --data "$data" --out "$out/$run" --set "training.minutes=$minutes" "${set[@]}"
}
