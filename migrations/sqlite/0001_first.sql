-- Identifiers are lower-case text, times are milliseconds since 1970 (UTC), documents are JSON text, so that every
-- statement reads the same in both databases.

CREATE TABLE plants (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    name TEXT NOT NULL UNIQUE,
    created_ms BIGINT NOT NULL
);

CREATE TABLE surveys (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
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
    path TEXT NOT NULL,
    kind TEXT NOT NULL CHECK (kind IN ('image', 'reconstruction')),
    size BIGINT NOT NULL,
    sha256 TEXT NOT NULL,
    width_px BIGINT,
    height_px BIGINT,
    stored_ms BIGINT NOT NULL,
    PRIMARY KEY (survey_id, path)
);

-- The queue. `fence` counts claims: whoever holds an older number has lost the job. A released job gives its attempt
-- back, never its fence.
CREATE TABLE jobs (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    plant_id TEXT NOT NULL REFERENCES plants (id) ON DELETE CASCADE,
    survey_id TEXT NOT NULL REFERENCES surveys (id) ON DELETE CASCADE,
    state TEXT NOT NULL CHECK (state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')),
    options TEXT NOT NULL,
    stage TEXT,
    done BIGINT NOT NULL DEFAULT 0,
    total BIGINT NOT NULL DEFAULT 0,
    warnings TEXT NOT NULL DEFAULT '[]',
    error_code TEXT,
    error_message TEXT,
    attempt BIGINT NOT NULL DEFAULT 0,
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
CREATE INDEX jobs_waiting ON jobs (state, run_after_ms);
CREATE INDEX jobs_of_plant ON jobs (plant_id, seq);
CREATE INDEX jobs_of_survey ON jobs (survey_id, seq);

-- A finished model; the whole of it is the blob `sha256`.
CREATE TABLE models (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
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
