#!/bin/sh
# Links the extra into Klipper, or takes the link away. Nothing else is changed; run it as the
# user that Klipper runs as.
#   ./install.sh [-k ~/klipper] [-n]      install; -n only says what would be done
#   ./install.sh -u [-k ~/klipper] [-n]   uninstall
set -eu
here=$(cd "$(dirname -- "$0")" && pwd)
klipper=${HOME:-}/klipper
remove='' dry=''

usage() { sed -n '4,5s/^#  *//p' "$0" >&2; exit 2; }
fail() { printf 'install.sh: %s\n' "$1" >&2; exit 2; }
run() { if [ -n "$dry" ]; then printf 'would run: %s\n' "$*"; else "$@"; fi; }

while getopts k:nu option; do
    case $option in
        k) klipper=$OPTARG ;;
        n) dry=yes ;;
        u) remove=yes ;;
        *) usage ;;
    esac
done
shift $((OPTIND - 1))
[ $# -eq 0 ] || usage
extras=$klipper/klippy/extras
[ -f "$klipper/klippy/klippy.py" ] && [ -d "$extras" ] ||
    fail "no Klipper in $klipper (no klippy/klippy.py); name its folder with -k"
link=$extras/stillpath
exclude=$klipper/.git/info/exclude line=klippy/extras/stillpath
[ ! -e "$link" ] || [ -L "$link" ] ||
    fail "$link is there and is no link: not made by this script, take it away by hand"

if [ -n "$remove" ]; then
    if [ -L "$link" ]; then
        run rm -- "$link"
        [ -n "$dry" ] || echo "Taken away: $link"
    else
        echo "Nothing to do: there is no $link"
    fi
    if grep -qx "$line" "$exclude" 2>/dev/null; then
        run sed -i "\\#^$line\$#d" "$exclude"
    fi
    echo "Take the section [stillpath] out of printer.cfg, then restart Klipper."
    exit 0
fi
# In an older Python Klipper does not start with the section [stillpath]. Many have 2.7 still.
python=$(dirname -- "$(cd "$klipper" && pwd -P)")/klippy-env/bin/python
if [ -x "$python" ] && ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 7))'; then
    fail "Klipper runs in $("$python" -V 2>&1) ($python), and the extra needs Python 3.7 or later: \
make klippy-env again with it, or print compensated files"
fi
if [ -L "$link" ] && [ "$(readlink "$link")" = "$here/stillpath" ]; then
    echo "Nothing to do: $link is there"
else
    run ln -sfn -- "$here/stillpath" "$link"
    [ -n "$dry" ] || echo "Linked: $link"
fi
# Klipper's updates must not call the checkout dirty.
if [ -d "$klipper/.git/info" ] && ! grep -qx "$line" "$exclude" 2>/dev/null; then
    if [ -n "$dry" ]; then
        echo "would add $line to $exclude"
    else
        # The last line of others may not be ended.
        [ ! -s "$exclude" ] || [ -z "$(tail -c 1 "$exclude")" ] || echo >> "$exclude"
        echo "$line" >> "$exclude"
    fi
fi
echo "Add to printer.cfg, then restart Klipper:"
echo "  [stillpath]"
echo "  file: ~/printer_data/config/stillpath.json"
