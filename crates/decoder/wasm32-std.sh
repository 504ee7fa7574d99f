#!/usr/bin/env bash
# Builds the decoder for wasm32-unknown-unknown on a Debian machine without that rustup target: uses Debian's compiler (package rustc-web),
# its library sources (rust-web-src) and -Zbuild-std, with rustup's cargo and linker. Installs nothing: unpacks the packages below
# ~/.cache/wasm32-std, or $WASM32_STD. `cargo xtask wasm` calls it with the arguments of cargo.
set -euo pipefail
root=${WASM32_STD:-$HOME/.cache/wasm32-std}
if [ ! -x "$root/usr/bin/rustc" ]; then
  mkdir -p "$root"
  (
    cd "$root"
    fetch() { apt-get -qq download "$@"; for d in *.deb; do dpkg -x "$d" .; done; rm -f ./*.deb; }
    # only the security updates have the newest compiler
    apt-get -qq update || true
    needs() { apt-cache depends "$1" | sed -n "s/.*Depends: *\($2[0-9.]*\).*/\1/p" | sort -V | tail -1; }
    std=$(needs libstd-rust-web-dev libstd-rust-web-)
    fetch rustc-web rust-web-src libstd-rust-web-dev "$std" "$(needs "$std" libllvm)"
    mkdir -p usr/lib/rustlib/src/rust
    ln -sfn "$(ls -d "$root"/usr/src/rustc-*/library)" usr/lib/rustlib/src/rust/library
  )
fi
sysroot=$(rustc --print sysroot)
host=$(rustc -vV | sed -n 's/^host: //p')
LD_LIBRARY_PATH=$(echo "$root"/usr/lib/*-linux-gnu) RUSTC=$root/usr/bin/rustc RUSTC_BOOTSTRAP=1 \
RUSTFLAGS="${RUSTFLAGS:-} --remap-path-prefix=$root=rust -C linker=$sysroot/lib/rustlib/$host/bin/rust-lld" \
exec "$sysroot/bin/cargo" "$@" -Zbuild-std=std,panic_abort
