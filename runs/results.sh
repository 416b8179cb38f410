#!/usr/bin/env bash
# Measure the released families and write RESULTS.md, step by step:
#   runs/results.sh KITTI TOWNS PANDASET NUSCENES [STEP...]
# KITTI has the splits val and labelled; TOWNS is a simulated set that no network was trained on (see `towns` below);
# PANDASET and NUSCENES have surround cameras.
#   FOLDS=   families that have not seen a place: FOLDS/without-pandaset and FOLDS/without-k09 with translators of the
#            last stage, and FOLDS/before, which neither had taught; MORE=: folder of the places k04 and k09
# Without a STEP all run in turn; each writes one file in docs/results:
#   make-towns  simulate TOWNS, TOWNS-tall and TOWNS-drive, unless they are there
#   val labelled towns tall pandaset nuscenes   scores, as CSV
#   folds                                  classes on a street that a run has not seen
#   unseen                                 classes of `world` on two such streets
#   beams remission                        scores with fewer beams and without remission
#   memory depth                           what each number of the memory of streams, and of depths, is worth
#   times                                  milliseconds on this machine
#   page        RESULTS.md and the scores of cards from these files; costs nothing
set -euo pipefail
kitti=$1 towns=$2 pandaset=$3 nuscenes=$4
pandaset=$(realpath "$pandaset") MORE=${MORE:+$(realpath "$MORE")} FOLDS=${FOLDS:+$(realpath "$FOLDS")}
shift 4
out=$(cd "$(dirname "$0")/../docs/results" && pwd)
scores() { # STEP EVALUATE-ARGUMENTS...
  lidar2pano evaluate "${@:2}" --csv "$out/$1.csv"
}
text() { # STEP COMMAND...
  "${@:2}" >"$out/$1.txt.new" && mv "$out/$1.txt.new" "$out/$1.txt"
}
idle() { # until others, and the steps before, leave the processors alone: their work would be in the times
  until awk '{ exit $1 > 0.3 }' /proc/loadavg; do sleep 30; done
}
step() {
  case $1 in
    make-towns)
      [ -d "$towns" ] || lidar2pano world "$towns" --sequences 5 --frames 4 --hz 10 --seed 909
      [ -d "$towns-tall" ] || lidar2pano world "$towns-tall" --sensor os1-128 --place centre --sequences 6 --frames 1 \
        --seed 71501 --view panorama-tall/2
      [ -d "$towns-drive" ] || lidar2pano world "$towns-drive" --sequences 2 --frames 10 --hz 10 --seed 3131
      ;;
    val) scores val streets world --data "$kitti" --split val ;;
    labelled) scores labelled world --data "$kitti" --split labelled --metrics points ;;
    towns) scores towns streets streets+steady world world+steady --data "$towns" --split all ;;
    tall) scores tall streets world --data "$towns-tall" --split all --elevation=-32,24 --metrics classes,depth,panorama ;;
    pandaset) (cd "$FOLDS" && scores pandaset without-pandaset --data "$pandaset" --split all) ;;
    folds)
      (cd "$FOLDS" && text folds lidar2pano evaluate before without-k09 --metrics classes --data "$MORE/k09" --split all)
      ;;
    unseen)
      text unseen lidar2pano evaluate world --metrics classes --folds k04="$MORE/k04:all" --folds k09="$MORE/k09:all"
      ;;
    nuscenes) scores nuscenes streets world --data "$nuscenes" --split all ;;
    beams) text beams python "$(dirname "$0")/fewer_beams.py" "$kitti" streets ;;
    remission) text remission python "$(dirname "$0")/remission_stand_in.py" --kitti "$kitti" --pandaset "$pandaset" ;;
    memory) text memory python "$(dirname "$0")/steady_ablation.py" "$towns-drive" streets ;;
    depth)
      text depth python "$(dirname "$0")/depth_ablation.py" streets "$MORE/k04:all" "$MORE/k09:all" "$pandaset:all" \
        "$nuscenes:all" "$towns:all" "$towns-drive:all"
      ;;
    times) idle && text times lidar2pano bench --weights streets --engine torch --runs 9 ;;
    page) python "$(dirname "$0")/results.py" && python "$(dirname "$0")/card_scores.py" ;;
    *) echo "$0: no step $1" >&2 && return 2 ;;
  esac
}
for each in "${@:-make-towns val labelled towns tall pandaset nuscenes folds unseen beams remission memory depth times page}"; do
  for name in $each; do step "$name"; done
done
