#!/bin/sh
# Make the screenshots of slicers anew: docs/make_slicer_images.sh FOLDER (their settings go there).
# The slicers are Debian 12's, PrusaSlicer 2.5.0 and Cura 4.13.0, on a screen that nobody sees. Clicks
# go to places, which move with the version: look at the pictures. Needs
#   apt-get install --no-install-recommends prusa-slicer cura xvfb openbox xdotool imagemagick locales
set -eu
docs=$(cd "$(dirname -- "$0")" && pwd)
mkdir -p "${1:?name a folder}"
cd "$1"
log=$PWD/log
mkdir -p locales prusa/print prusa/filament prusa/printer config/cura/4.13/scripts \
    data/cura/4.13/machine_instances data/cura/4.13/extruders
localedef -i en_US -f UTF-8 "$PWD/locales/en_US.UTF-8"
export LOCPATH="$PWD/locales" LC_ALL=en_US.UTF-8 LIBGL_ALWAYS_SOFTWARE=1 HOME="$PWD"
export XDG_DATA_HOME="$PWD/data" XDG_CONFIG_HOME="$PWD/config" XDG_CACHE_HOME="$PWD/cache"

started=
stop() { for pid in $started; do kill "$pid" 2>/dev/null || :; wait "$pid" 2>/dev/null || :; done; }
trap stop EXIT
trap 'exit 1' INT TERM
start() { "$@" >>"$log" 2>&1 & started="$! $started"; }
window() { # sets id as soon as there is such a window
    for _ in $(seq 180); do
        id=$(xdotool search --onlyvisible --name "$1" 2>>"$log" | tail -n 1)
        [ -z "$id" ] || return 0
        sleep 1
    done
    echo "no window $1; see $log" >&2
    exit 1
}
click() { xdotool mousemove "$1" "$2" click 1; sleep 3; }
shoot() { import -window root -crop "$2" +repage -strip -define webp:lossless=true "$docs/images/$1"; }

start Xvfb -displayfd 3 -screen 0 1100x860x24 -nolisten tcp 3>display; sleep 3
export DISPLAY=":$(cat display)"
start openbox

printf '%s\n' 'version = 2.5.0' 'version_system_info_sent = 2.5.0' 'view_mode = expert' \
    'show_splash_screen = 0' 'show_hints = 0' 'notify_release = none' \
    '[presets]' 'print = 0.20 mm' 'filament = PLA' 'printer = Ender 3' > prusa/PrusaSlicer.ini
printf '%s\n' 'layer_height = 0.2' 'post_process = /home/you/stillpath/.venv/bin/stillpath-post' \
    > 'prusa/print/0.20 mm.ini'
echo filament_type = PLA > prusa/filament/PLA.ini
echo gcode_flavor = marlin2 > 'prusa/printer/Ender 3.ini'
start prusa-slicer --datadir "$PWD/prusa"
window '^PrusaSlicer'
sleep 10
xdotool windowsize "$id" 1100 650 windowmove "$id" 0 0 key ctrl+2 # Print Settings
sleep 5
click 90 320 # Output options
shoot slicer-prusaslicer.webp 1100x640+0+0
kill "${started%% *}"

cp "$docs/../integrations/cura/Stillpath.py" config/cura/4.13/scripts/
printf '%s\n' '[general]' 'version = 7' 'last_run_version = 4.13.0' 'accepted_user_agreement = True' \
    'window_width = 1000' 'window_height = 800' 'window_left = 0' 'window_top = 0' \
    '[info]' 'send_slice_info = False' 'asked_send_slice_info = True' 'automatic_update_check = False' \
    '[cura]' 'active_machine = Ender-3' > config/cura/4.13/cura.cfg
stack() { # file, type, a property; containers, from the user's changes to the definition
    printf '%s\n' '[general]' 'version = 5' "id = $(basename "$1" ".${1#*.}")" 'name = Ender-3' \
        '[metadata]' 'setting_version = 19' "type = $2" "$3" '[containers]' > "data/cura/4.13/$1"
    printf '%d = %s\n' 0 empty 1 empty_quality_changes 2 empty_intent 3 "$4" 4 "$5" 5 "$6" \
        6 empty_definition_changes 7 "$7" >> "data/cura/4.13/$1"
}
stack machine_instances/Ender-3.global.cfg machine 'group_id = 1' \
    base_global_standard empty_material empty_variant creality_ender3
stack extruders/train.extruder.cfg extruder_train "$(printf 'machine = Ender-3\nposition = 0')" \
    base_0.4_PLA_standard generic_pla_175 creality_ender3_0.4 creality_base_extruder_0
start cura
window '^Ultimaker Cura'
sleep 30
click 186 12 # Extensions
xdotool key Down Down Right sleep 1 key Return # Post Processing, Modify G-Code
window '^Post Processing'
xdotool windowsize "$id" 860 520 windowmove "$id" 20 40 sleep 3
click 78 108 # Add a script
click 60 460 # Stillpath
xdotool windowsize "$id" 860 380 mousemove 300 300 sleep 3
shoot slicer-cura.webp 862x407+19+18
