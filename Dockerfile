# The steps of `make setup` and `cargo build`; the final image holds only what the program needs.

FROM node:20-bookworm AS web
WORKDIR /heliomap
COPY Makefile ./
COPY web/ web/
RUN make web

FROM rust:1.95-bookworm AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends make python3 python3-pip \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /heliomap
COPY Makefile ./
RUN make .ort/libonnxruntime.so
COPY Cargo.toml Cargo.lock ./
COPY crates/ crates/
COPY migrations/ migrations/
COPY src/ src/
COPY --from=web /heliomap/web/dist/ web/dist/
RUN cargo build --release --locked --bin heliomap

FROM debian:bookworm-slim
# Certificates of public authorities, for object stores, identity providers and receivers of webhooks; Python for what
# reconstructs photos.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
COPY crates/photogrammetry/engine/requirements.txt /tmp/requirements.txt
RUN python3 -m venv /opt/reconstruct \
    && /opt/reconstruct/bin/pip install --no-cache-dir --requirement /tmp/requirements.txt
RUN useradd --system --uid 10001 --home-dir /data heliomap \
    && install --directory --owner=heliomap --group=heliomap /data
COPY --from=build /heliomap/target/release/heliomap /usr/local/bin/heliomap
COPY --from=build /heliomap/.ort/libonnxruntime.so /usr/local/lib/libonnxruntime.so
COPY models/ /usr/local/share/heliomap/models/
ENV ORT_DYLIB_PATH=/usr/local/lib/libonnxruntime.so \
    HELIOMAP_DATA_DIR=/data \
    HELIOMAP_RECONSTRUCT_PYTHON=/opt/reconstruct/bin/python \
    HELIOMAP_LISTEN=0.0.0.0:8080 \
    HELIOMAP_LOG_FORMAT=json
USER 10001
VOLUME /data
EXPOSE 8080
ENTRYPOINT ["heliomap"]
CMD ["serve"]
