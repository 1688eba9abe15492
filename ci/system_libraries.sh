#!/usr/bin/env bash
# Installs the shared libraries that Blender and headless OpenGL need, and only those that are missing.
# Without root, or without apt, it names them and goes on: the parts that need none of them still work.
set -euo pipefail

[ "$(uname)" = Linux ] || exit 0
PATH=$PATH:/usr/sbin:/sbin # ldconfig is not on everyone's path

known=$(ldconfig -p)
missing=()
library() { # soname package
    [[ $known == *"$1"* ]] || missing+=("$2")
}
library libXrender.so.1 libxrender1
library libXi.so.6 libxi6
library libxkbcommon.so.0 libxkbcommon0
library libSM.so.6 libsm6
library libGL.so.1 libgl1
library libEGL.so.1 libegl1
# Mesa's software renderer, for machines without a GPU driver that offers EGL.
has_software_renderer() {
    compgen -G "/usr/lib*/dri/swrast_dri.so" || compgen -G "/usr/lib/*/dri/swrast_dri.so" ||
        compgen -G "/usr/lib*/libgallium-*.so" || compgen -G "/usr/lib/*/libgallium-*.so"
}
if [[ $known != *libEGL_nvidia.so* ]] && ! has_software_renderer >/dev/null; then
    missing+=(libgl1-mesa-dri)
fi

if [ ${#missing[@]} -eq 0 ]; then
    exit 0
fi
run=()
if [ "$(id -u)" -ne 0 ]; then
    run=(sudo -n)
fi
if command -v apt-get >/dev/null && "${run[@]}" true 2>/dev/null; then
    "${run[@]}" apt-get update -q
    "${run[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${missing[@]}"
else
    echo "warning: these system libraries are missing and need an administrator: ${missing[*]} (Debian names)" >&2
fi
