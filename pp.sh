#!/bin/sh
unset LD_LIBRARY_PATH LD_PRELOAD
/bin/cp "$1" /tmp/w_q1/pp.gcode
