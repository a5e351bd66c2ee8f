-- Identifiers are lower-case text, times are milliseconds since 1970 (UTC), documents are JSON text, so that every
-- statement reads the same in both databases. What is sorted by text is sorted by its bytes, as SQLite does.

-- The nil organisation owns what is done without a key where the service runs with --insecure.
CREATE TABLE organisations (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    name TEXT NOT NULL UNIQUE,
    created_ms BIGINT NOT NULL
);

INSERT INTO organisations (id, name, created_ms) VALUES ('00000000-0000-0000-0000-000000000000', 'default', 0);

-- Names of plants are each organisation's own.
CREATE TABLE plants (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    organisation_id TEXT NOT NULL REFERENCES organisations (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    created_ms BIGINT NOT NULL,
    UNIQUE (organisation_id, name)
);

CREATE INDEX plants_of_organisation ON plants (organisation_id, seq);

CREATE TABLE surveys (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    plant_id TEXT NOT NULL REFERENCES plants (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    created_ms BIGINT NOT NULL,
    UNIQUE (plant_id, name)
);

CREATE INDEX surveys_of_plant ON surveys (plant_id, seq);

-- What was uploaded to a survey: its place in the survey's folder, and the blob with its bytes.
CREATE TABLE files (
    survey_id TEXT NOT NULL REFERENCES surveys (id) ON DELETE CASCADE,
    path TEXT COLLATE "C" NOT NULL,
    kind TEXT NOT NULL CHECK (kind IN ('image', 'reconstruction')),
    size BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    width_px BIGINT,
    height_px BIGINT,
    stored_ms BIGINT NOT NULL,
    PRIMARY KEY (survey_id, path)
);

-- The queue. `fence` counts claims: whoever holds an older number has lost the job. A released job gives its attempt
-- back, never its fence. `attempts_before` counts the attempts before the last one that got somewhere: only those since
-- then count against `max_attempts`. `stage_ms` is what each stage took, JSON, for the next job's estimate.
CREATE TABLE jobs (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    plant_id TEXT NOT NULL REFERENCES plants (id) ON DELETE CASCADE,
    survey_id TEXT NOT NULL REFERENCES surveys (id) ON DELETE CASCADE,
    state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    options TEXT NOT NULL,
    priority BIGINT NOT NULL DEFAULT 0,
    stage TEXT,
    done BIGINT NOT NULL DEFAULT 0,
    total BIGINT NOT NULL DEFAULT 0,
    remaining_ms BIGINT,
    stage_ms TEXT,
    warnings TEXT NOT NULL DEFAULT '[]',
    error_code TEXT,
    error_message TEXT,
    attempt BIGINT NOT NULL DEFAULT 0,
    attempts_before BIGINT NOT NULL DEFAULT 0,
    max_attempts BIGINT NOT NULL,
    fence BIGINT NOT NULL DEFAULT 0,
    worker TEXT,
    run_after_ms BIGINT NOT NULL,
    lease_until_ms BIGINT,
    cancel_requested BOOLEAN NOT NULL DEFAULT FALSE,
    model_version BIGINT,
    created_ms BIGINT NOT NULL,
    started_ms BIGINT,
    finished_ms BIGINT
);

-- A survey is never mapped twice at once.
CREATE UNIQUE INDEX jobs_one_unfinished_per_survey ON jobs (survey_id) WHERE state IN ('queued', 'running');
CREATE INDEX jobs_waiting ON jobs (state, priority, seq);
CREATE INDEX jobs_of_plant ON jobs (plant_id, seq);
CREATE INDEX jobs_of_survey ON jobs (survey_id, seq);

-- A finished model; the whole of it is the blob `sha256`.
CREATE TABLE models (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    plant_id TEXT NOT NULL REFERENCES plants (id) ON DELETE CASCADE,
    version BIGINT NOT NULL,
    survey_id TEXT NOT NULL,
    job_id TEXT NOT NULL,
    sha256 TEXT NOT NULL,
    size BIGINT NOT NULL,
    warnings TEXT NOT NULL,
    created_ms BIGINT NOT NULL,
    UNIQUE (plant_id, version)
);

-- One layer of a model: its collection's own members, its extent, and the largest extent north to south of one
-- feature, which bounds how far outside a box a feature that touches it may begin.
CREATE TABLE layers (
    model_seq BIGINT NOT NULL REFERENCES models (seq) ON DELETE CASCADE,
    layer TEXT NOT NULL,
    features BIGINT NOT NULL,
    properties TEXT NOT NULL,
    min_lon DOUBLE PRECISION,
    min_lat DOUBLE PRECISION,
    max_lon DOUBLE PRECISION,
    max_lat DOUBLE PRECISION,
    tallest_deg DOUBLE PRECISION NOT NULL,
    PRIMARY KEY (model_seq, layer)
);

CREATE TABLE features (
    model_seq BIGINT NOT NULL REFERENCES models (seq) ON DELETE CASCADE,
    layer TEXT NOT NULL,
    seq BIGINT NOT NULL,
    id TEXT NOT NULL,
    label TEXT NOT NULL,
    feature TEXT NOT NULL,
    min_lon DOUBLE PRECISION,
    min_lat DOUBLE PRECISION,
    max_lon DOUBLE PRECISION,
    max_lat DOUBLE PRECISION,
    PRIMARY KEY (model_seq, layer, seq)
);

CREATE UNIQUE INDEX features_by_id ON features (id, model_seq);
CREATE INDEX features_by_place ON features (model_seq, layer, min_lat, max_lat, min_lon, max_lon, seq);

-- A key's secret is nowhere, its SHA-256 digest here: secrets have 256 random bits, so that no salt is needed. `scopes`
-- and `plants` are words with blanks between them; `plants` is NULL where all of the organisation's are meant. After a
-- rotation the previous secret goes on until its time.
CREATE TABLE api_keys (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id TEXT NOT NULL UNIQUE,
    organisation_id TEXT NOT NULL REFERENCES organisations (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    prefix TEXT NOT NULL,
    sha256 TEXT NOT NULL UNIQUE,
    previous_sha256 TEXT UNIQUE,
    previous_until_ms BIGINT,
    scopes TEXT NOT NULL,
    plants TEXT,
    created_ms BIGINT NOT NULL,
    expires_ms BIGINT,
    revoked_ms BIGINT,
    last_used_ms BIGINT
);

CREATE INDEX api_keys_of_organisation ON api_keys (organisation_id, seq);

-- What was done, by whom, and how it ended. Rows outlive the keys and plants that they speak of.
CREATE TABLE audit (
    seq BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    organisation_id TEXT NOT NULL REFERENCES organisations (id) ON DELETE CASCADE,
    at_ms BIGINT NOT NULL,
    key_id TEXT,
    key_name TEXT,
    method TEXT NOT NULL,
    path TEXT NOT NULL,
    status BIGINT NOT NULL,
    request_id TEXT NOT NULL
);

CREATE INDEX audit_of_organisation ON audit (organisation_id, seq);

-- What a job has found so far, image by image. It holds for input, options and program with this fingerprint alone, and
-- goes when the job ends.
CREATE TABLE checkpoints (
    job_id TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    name TEXT COLLATE "C" NOT NULL,
    fingerprint TEXT NOT NULL,
    document BYTEA NOT NULL,
    PRIMARY KEY (job_id, name)
);

-- Plants that were deleted and whose blobs may still lie there.
CREATE TABLE deleted_plants (
    plant_id TEXT NOT NULL PRIMARY KEY,
    deleted_ms BIGINT NOT NULL
);

-- Uploads that may be resumed. Their bytes lie in a file of their own until they are whole; `received` is how many of them
-- are safe. `outcome` is what became of the whole file, JSON.
CREATE TABLE uploads (
    id TEXT NOT NULL PRIMARY KEY,
    survey_id TEXT NOT NULL REFERENCES surveys (id) ON DELETE CASCADE,
    length BIGINT NOT NULL,
    received BIGINT NOT NULL,
    partial BOOLEAN NOT NULL,
    metadata TEXT NOT NULL,
    expires_ms BIGINT NOT NULL,
    outcome TEXT
);

CREATE INDEX uploads_by_expiry ON uploads (expires_ms);
