#!/usr/bin/env bash
# Write RESULTS.md: scores of the released families (and of other weights beside them), and times on this machine.
#   runs/results.sh KITTI TOWNS PANDASET NUSCENES [WEIGHTS|RUN...]
# KITTI has the splits val and labelled; TOWNS is a simulated set that no network was trained on (runs/release.sh makes it);
# PANDASET and NUSCENES have surround cameras. WEIGHTS are scored beside the families on KITTI.
set -euo pipefail
kitti=$1 towns=$2 pandaset=$3 nuscenes=$4
shift 4
cd "$(dirname "$0")/.."
panorama() { # TITLE ROOT
  echo
  echo "## $1"
  echo
  lidar2pano evaluate world world+steady kitti-mini kitti-mini+steady --data "$2" --split all
}
{
  echo '# Results'
  echo
  echo 'Written by `runs/results.sh`; not edited by hand.'
  echo
  echo '## Camera sector, from the scan alone'
  echo
  lidar2pano evaluate kitti-mini world "$@" --data "$kitti" --split val
  echo
  echo '## Points, against manual labels'
  echo
  lidar2pano evaluate world --data "$kitti" --split labelled --metrics points
  echo
  echo '## Fewer beams: every, every second and every fourth beam of the scans of `val`'
  echo
  python runs/fewer_beams.py "$kitti" kitti-mini "$@"
  echo
  echo '## Without remission: mIoU of point classes with constants in its place (`val` and PandaSet)'
  echo
  python runs/remission_stand_in.py --kitti "$kitti" --pandaset "$pandaset"
  panorama 'Panorama: towns of the street world that no network was trained on' "$towns"
  panorama 'Panorama: PandaSet' "$pandaset"
  panorama 'Panorama: a nuScenes sample' "$nuscenes"
  echo
  echo '## Times'
  echo
  lidar2pano bench --weights kitti-mini --runs 9
} >RESULTS.md.new
mv RESULTS.md.new RESULTS.md
