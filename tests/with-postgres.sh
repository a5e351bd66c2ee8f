#!/usr/bin/env bash
# Runs a command beside a Postgres server of its own, which HELIOMAP_TEST_POSTGRES names and which ends with the command:
#   tests/with-postgres.sh cargo test
# With HELIOMAP_TEST_TLS it takes encrypted connections alone, and HELIOMAP_TEST_POSTGRES_AUTHORITY names whom to trust.
# Installs Postgres by apt where there is none and the user may.
set -euo pipefail

programs() { command -v initdb || ls -d /usr/lib/postgresql/*/bin/initdb 2>/dev/null | sort -V | tail -1; }
if [ -z "$(programs)" ]; then
    echo "installing Postgres" >&2
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq --yes --no-install-recommends postgresql >/dev/null
fi
bin=$(dirname "$(readlink -f "$(programs)")")

# Postgres refuses to run as root.
as_user=()
if [ "$(id -u)" = 0 ]; then
    as_user=(setpriv --reuid=postgres --regid=postgres --clear-groups)
fi
folder=$(mktemp -d -t heliomap-postgres-XXXXXX)
[ "$(id -u)" = 0 ] && chown postgres "$folder"
# An address of the machine's own or, in a network namespace made for a test, of that one.
address=${HELIOMAP_TEST_LISTEN:-127.0.0.1}
port=$(python3 -c 'import socket, sys; s = socket.socket(); s.bind((sys.argv[1], 0)); print(s.getsockname()[1])' "$address")
finish() {
    "${as_user[@]}" "$bin/pg_ctl" --pgdata="$folder/data" --mode=immediate --silent stop >/dev/null 2>&1 || true
    rm -rf "$folder"
}
trap finish EXIT
cd_back=$PWD
cd "$folder"
"${as_user[@]}" "$bin/initdb" --pgdata="$folder/data" --username=heliomap --auth=trust --no-sync >"$folder/log" 2>&1 || { cat "$folder/log" >&2; exit 1; }
echo "host all all $address/24 trust" >>"$folder/data/pg_hba.conf"
options="-c listen_addresses=$address -c port=$port -c unix_socket_directories=$folder -c max_connections=300"
if [ -n "${HELIOMAP_TEST_TLS:-}" ]; then
    # A certificate of this address, by an authority of which nobody knows but whoever is told.
    key=(-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2)
    openssl req -x509 "${key[@]}" -subj /CN=authority -keyout authority.key -out authority.pem 2>>log
    openssl req "${key[@]}" -subj /CN=server -keyout server.key -out server.csr 2>>log
    openssl x509 -req -in server.csr -CA authority.pem -CAkey authority.key -days 2 -out server.pem 2>>log \
        -extfile <(echo "subjectAltName=IP:$address")
    [ "$(id -u)" = 0 ] && chown postgres server.key
    sed -i 's/^host /hostssl /' "$folder/data/pg_hba.conf"
    options+=" -c ssl=on -c ssl_cert_file=$folder/server.pem -c ssl_key_file=$folder/server.key"
    export HELIOMAP_TEST_POSTGRES_AUTHORITY="$folder/authority.pem"
fi
"${as_user[@]}" "$bin/pg_ctl" --pgdata="$folder/data" --log="$folder/data/server.log" --silent --wait \
    --options="$options" start >/dev/null
cd "$cd_back"
export HELIOMAP_TEST_POSTGRES="postgres://heliomap@$address:$port"
export HELIOMAP_TEST_POSTGRES_BIN=$bin
"$@"
