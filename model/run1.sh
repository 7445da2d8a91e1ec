#!/bin/bash
d=$(mktemp -d); cp keys_life.pml $d; cd $d
spin -a "${@}" keys_life.pml > gen.log 2>&1 || { cat gen.log; exit 1; }
gcc -O2 -DSAFETY ${MODE:--DCOLLAPSE} -DNOFAIR -DREACH -DMEMLIM=6000 -o pan pan.c 2>gcc.log || { head gcc.log; exit 1; }
timeout ${T:-500} ./pan -m100000 -w24 $PAN | grep -E "errors|states, stored|assertion|elapsed" | head
[ -f *.trail ] && { spin -t -p "${@}" keys_life.pml 2>/dev/null | grep -E "proc" | grep -v "end state" | sed 's/keys_life.pml//; s/creates.*//' | tail -60; }
rm -rf $d
