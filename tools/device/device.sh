#!/bin/sh
# What happens on a device when SHARE is put there. tools/deploy sends it; by hand, on the device itself:
#     sudo sh /opt/share/current/deploy/device.sh rollback
# SHARE_ROOT: a folder in place of /, for tests. Needs what a bare Debian or Ubuntu has: sh, tar, gzip, systemd.
set -eu
trap '' PIPE HUP INT # the line may break, or who looks on may leave: what was begun is ended, or taken back
ROOT=${SHARE_ROOT:-}
SETTLE=${SHARE_SETTLE:-10} # seconds for which a service must stay up
KEEP=${SHARE_KEEP:-3}      # releases
OPT=$ROOT/opt/share ETC=$ROOT/etc/share VAR=$ROOT/var/lib/share
UNITS=$ROOT/etc/systemd/system RULES=$ROOT/etc/udev/rules.d BOOT=$ROOT/etc/tmpfiles.d

ROUTINE='^(Starting|Started|Stopping|Stopped) |: (Scheduled restart job|Failed with result)' # what systemd says at each try

say() { echo "share: $*" || :; } # perhaps to nobody
die() { echo "$*" >&2 || :; exit 1; }
release() { readlink "$OPT/$1" 2>/dev/null | sed 's|^releases/||'; } # current or previous: which it is
services() { cat "$ETC/services" 2>/dev/null || true; }

probe() { # facts as KEY=VALUE; changes nothing
    there=$OPT
    while [ ! -d "$there" ]; do there=$(dirname "$there"); done
    echo "machine=$(uname -m)"
    echo "glibc=$(getconf GNU_LIBC_VERSION 2>/dev/null | sed 's/.* //')"
    echo "free_kb=$(df -Pk "$there" | awk 'NR == 2 {print $4}')"
    echo "systemd=$(command -v systemctl >/dev/null && echo yes || echo no)"
    echo "current=$(release current)"
    echo "previous=$(release previous)"
    echo "releases=$(ls "$OPT/releases" 2>/dev/null | tr '\n' ' ')"
    [ ! -f "$ETC/$1.env" ] || sed 's/^/env:/' "$ETC/$1.env"
}

receive() { # RELEASE: a tar of it from stdin
    rm -rf "$OPT"/releases/.incoming-*
    mkdir -p "$OPT/releases/.incoming-$1"
    tar -xz --no-same-owner -f - -C "$OPT/releases/.incoming-$1" || {
        rm -rf "$OPT/releases/.incoming-$1"
        die "the program could not be unpacked"
    }
    mv -T "$OPT/releases/.incoming-$1" "$OPT/releases/$1"
}

settings() { # FILE: from stdin; in force with the next activate
    mkdir -p "$ETC/.new"
    cat >"$ETC/.new/$1"
}

activate() { # RELEASE UNIT PROFILE
    old=$(release current) known=$(services | grep -x "$2" || true)
    make_user
    make_keys "$1" "$2"
    changed=$(take_settings)
    [ -n "$known" ] || echo "$2" >>"$ETC/services"
    echo "$3" >"$ETC/profile"
    if [ "$old" = "$1" ] && [ -z "$changed" ] && systemctl is-active --quiet "$2"; then
        say "$1 runs already, with these settings"
        show_key
        return
    fi
    switch "$1"
    systemctl enable "$2" >/dev/null 2>&1 || die "systemctl enable $2 failed"
    restart_all
    if healthy; then
        rm -rf "$ETC/.before"
        settled "$1" "$old"
        say "$1 runs"
        show_key
    else
        put_back_settings
        [ -n "$known" ] || stop_for_good "$2"
        go_back "$1" "$old"
    fi
}

place() { # RELEASE: the program alone; services that are here go on with it
    old=$(release current)
    make_user
    let_in
    [ -f "$ETC/profile" ] || echo d435i >"$ETC/profile"
    if [ "$old" = "$1" ]; then
        say "$1 is there already"
        return
    fi
    switch "$1"
    restart_all
    if healthy; then
        settled "$1" "$old"
        say "$1 is there"
    else
        go_back "$1" "$old"
    fi
}

settled() { # RELEASE OLD: it stays
    [ "$2" = "$1" ] || [ -z "$2" ] || point previous "$2"
    prune
}

let_in() { # who became root for this may open the camera, from the next login on
    [ -z "${SUDO_USER:-}" ] || id -nG "$SUDO_USER" | grep -qw plugdev || usermod -aG plugdev "$SUDO_USER"
}

go_back() { # RELEASE OLD: to OLD and what ran with it
    [ -n "$2" ] || die "$1 does not run; there is no other release to go back to, so it is stopped"
    switch "$2"
    restart_all
    healthy || die "$1 does not run, nor does $2, to which all was put back"
    so=" and runs"
    [ -n "$(services)" ] || so=", without a service"
    [ "$1" != "$2" ] || die "$1 does not run like this; all is as it was$so"
    die "$1 does not run; $2 is back$so"
}

stop_for_good() { # UNIT
    systemctl disable --now "$1" >/dev/null 2>&1 || true
    services | grep -vx "$1" >"$ETC/.services" || true
    mv "$ETC/.services" "$ETC/services"
}

rollback() { # to the release before
    old=$(release current) back=$(release previous)
    [ -n "$back" ] && [ -d "$OPT/releases/$back" ] || die "there is no previous release to go back to"
    switch "$back"
    restart_all
    point previous "$old"
    healthy || die "$back is back, but does not run; the other one is $old"
    say "$back runs; rollback again for $old"
}

switch() { # RELEASE: its program, units, udev rules and settings of the kernel
    touch "$OPT/releases/$1"
    mkdir -p "$UNITS" "$RULES" "$ROOT/usr/local/bin"
    cp "$OPT/releases/$1"/deploy/*.service "$UNITS/"
    cmp -s "$OPT/releases/$1"/deploy/*.rules "$RULES/99-share-realsense.rules" || {
        cp "$OPT/releases/$1"/deploy/*.rules "$RULES/99-share-realsense.rules"
        # waited for, or a service that starts before it may open the camera counts as one that fails
        udevadm control --reload-rules && udevadm trigger && udevadm settle -t 10 || say "udev did not reload"
    }
    set_kernel "$OPT/releases/$1/deploy/$(cat "$ETC/profile" || :).conf"
    ln -sfn /opt/share/current/share "$ROOT/usr/local/bin/share"
    point current "$1"
}

set_kernel() { # FILE: what the profile asks of processor and USB, now and at every start; an old release has none
    [ -f "$1" ] || return 0
    mkdir -p "$BOOT"
    cp "$1" "$BOOT/share.conf"
    systemd-tmpfiles --create "$BOOT/share.conf" || say "the kernel did not take all of /etc/tmpfiles.d/share.conf"
    ppd=power-profiles-daemon.service # of desktops
    if grep -q scaling_governor "$1" && [ -e "$ROOT/usr/lib/systemd/system/$ppd" ] &&
        [ "$(readlink "$UNITS/$ppd")" != /dev/null ] &&
        ls "$ROOT"/sys/devices/system/cpu/cpufreq/policy*/energy_performance_preference >/dev/null 2>&1; then
        say "$ppd sets the CPU governor back whenever it starts; to keep it: sudo systemctl mask --now $ppd"
    fi
}

point() { # LINK RELEASE: at once, so that nobody ever finds none
    ln -sfn "releases/$2" "$OPT/.$1"
    mv -T "$OPT/.$1" "$OPT/$1"
}

restart_all() {
    systemctl daemon-reload
    for unit in $(services); do systemctl restart "$unit" || say "$unit does not start"; done
}

healthy() { # all services stay up, and what is made of machine code loads here
    before=$(restarts)
    [ -z "$(services)" ] || sleep "$SETTLE"
    fine=yes
    for unit in $(services); do
        { systemctl is-active --quiet "$unit" && echo "$before" | grep -qxF "$(started "$unit")"; } || complain "$unit"
    done
    [ "$fine" = yes ] && checkup
}

restarts() { for unit in $(services); do started "$unit"; done; }

started() { echo "$1 $(systemctl show -p NRestarts "$1")"; } # how often anew, by itself

complain() { # UNIT: that it does not stay up, and the last that it said
    fine=no
    say "$1 did not stay up for $SETTLE s:"
    journalctl -u "$1" -n 50 -o cat --no-pager 2>/dev/null | grep -vE "$ROUTINE" | tail -n 5 | sed 's/^/    /'
}

checkup() { # shows what the doctor finds; only the libraries are the program's own
    found=$("$OPT/current/share" doctor --json --profile "$(cat "$ETC/profile")" --keys "$ETC/keys" --out "$VAR" \
        2>&1 | tr '{' '\n' | sed -n 's/.*"name": "\([^"]*\)", "state": "\([A-Z]*\)", "what": "\([^"]*\)".*/\2 \1: \3/p')
    echo "$found" | grep -E '^(FAIL|WARN)' | grep -v ' port:' | sed 's/^/    doctor: /' || true # the edge has its port
    echo "$found" | grep -q '^OK libraries' || { say "its libraries do not load here"; return 1; }
}

prune() { # the newest $KEEP stay, and those in use
    ls -1t "$OPT/releases" | tail -n +$((KEEP + 1)) | while read -r name; do
        [ "$name" = "$(release current)" ] || [ "$name" = "$(release previous)" ] || rm -rf "$OPT/releases/$name"
    done
}

make_user() {
    getent group plugdev >/dev/null || groupadd --system plugdev
    id -u share >/dev/null 2>&1 ||
        useradd --system --no-create-home --home-dir /var/lib/share --shell /usr/sbin/nologin share
    mkdir -p "$VAR" "$ETC"
    chown share: "$VAR"
}

make_keys() { # RELEASE UNIT: this machine's pair, once
    name=$(echo "$2" | sed 's/^share-agent@//; s/^share-//; s/\.service$//')
    set -- "$OPT/releases/$1/share"
    ls "$ETC"/keys/*.secret >/dev/null 2>&1 || "$1" keys generate --name "$name" --keys "$ETC/keys" >/dev/null 2>&1 ||
        die "keys could not be made in $ETC/keys"
    chown -R share: "$ETC/keys"
}

show_key() {
    say "this machine's public key, which the other side wants (docs/do/keys.md):"
    cat "$ETC"/keys/*.public || :
}

take_settings() { # prints the names of those that differ; the old ones are kept until all is well
    rm -rf "$ETC/.before"
    mkdir -p "$ETC/.before"
    for new in "$ETC"/.new/*; do
        [ -f "$new" ] || continue
        name=${new##*/}
        cmp -s "$new" "$ETC/$name" && continue
        [ ! -f "$ETC/$name" ] || cp -p "$ETC/$name" "$ETC/.before/$name"
        mv "$new" "$ETC/$name"
        echo "$name"
    done
    rm -rf "$ETC/.new"
}

put_back_settings() {
    for kept in "$ETC"/.before/*; do [ ! -f "$kept" ] || mv "$kept" "$ETC/"; done
    rm -rf "$ETC/.before"
}

case ${1:-} in
probe | receive | settings | activate | place | rollback) "$@" ;;
*) die "usage: device.sh probe UNIT | receive RELEASE | settings FILE | activate RELEASE UNIT PROFILE | place RELEASE | rollback" ;;
esac
