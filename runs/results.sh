#!/usr/bin/env bash
# Write RESULTS.md: scores of the released weights (and of other runs beside them), and times on this machine.
#   runs/results.sh DATA [WEIGHTS|RUN...]
set -euo pipefail
data=$1
shift
cd "$(dirname "$0")/.."
{
  echo '# Results'
  echo
  echo 'Written by `runs/results.sh`; nothing here is typed.'
  echo
  echo '## Camera sector, from the scan alone'
  echo
  lidar2pano evaluate kitti-mini "$@" --data "$data" --split val
  echo
  echo '## Times'
  echo
  lidar2pano bench --weights kitti-mini --runs 9
} >RESULTS.md.new
mv RESULTS.md.new RESULTS.md
