#!/usr/bin/env bash
# Runs a command beside an S3-compatible server of its own (moto's, in memory), which HELIOMAP_TEST_S3 names and which ends
# with the command; its bucket is heliomap-tests:
#   tests/with-s3.sh cargo test --test store
set -euo pipefail

python=${HELIOMAP_S3_PYTHON:-$(dirname "$0")/../.venv/s3/bin/python}
if [ ! -x "$python" ]; then
    echo "there is no $python: run \`make .venv/s3/done\` first" >&2
    exit 1
fi
folder=$(mktemp -d -t heliomap-s3-XXXXXX)
server=
finish() {
    [ -n "$server" ] && kill "$server" 2>/dev/null && wait "$server" 2>/dev/null || true
    rm -rf "$folder"
}
trap finish EXIT
# An address of the machine's own or, in a network namespace made for a test, of that one.
address=${HELIOMAP_TEST_LISTEN:-127.0.0.1}
port=$(python3 -c 'import socket, sys; s = socket.socket(); s.bind((sys.argv[1], 0)); print(s.getsockname()[1])' "$address")
"$python" -m moto.server --host "$address" --port "$port" >"$folder/log" 2>&1 &
server=$!
export HELIOMAP_TEST_S3="http://$address:$port"
python3 - "$HELIOMAP_TEST_S3/heliomap-tests" <<'END' || { cat "$folder/log" >&2; exit 1; }
import sys, time, urllib.request
for _ in range(300):
    try:
        urllib.request.urlopen(urllib.request.Request(sys.argv[1], method="PUT"), timeout=5).read()
        break
    except OSError:
        time.sleep(0.1)
else:
    sys.exit("the S3-compatible server does not answer")
END
"$@"
