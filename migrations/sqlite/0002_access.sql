-- Who may do what. The nil organisation owns what was there before there were organisations, and what is done without
-- a key where the service runs with --insecure.

CREATE TABLE organisations (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    name TEXT NOT NULL UNIQUE,
    created_ms BIGINT NOT NULL
);

INSERT INTO organisations (id, name, created_ms) VALUES ('00000000-0000-0000-0000-000000000000', 'default', 0);

-- Names of plants are each organisation's own.
CREATE TABLE plants_anew (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    organisation_id TEXT NOT NULL REFERENCES organisations (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    created_ms BIGINT NOT NULL,
    UNIQUE (organisation_id, name)
);

INSERT INTO plants_anew (seq, id, organisation_id, name, created_ms)
SELECT seq, id, '00000000-0000-0000-0000-000000000000', name, created_ms FROM plants;

DROP TABLE plants;
ALTER TABLE plants_anew RENAME TO plants;
CREATE INDEX plants_of_organisation ON plants (organisation_id, seq);

-- A key's secret is nowhere, its SHA-256 digest here: secrets have 256 random bits, so that no salt is needed. `scopes`
-- and `plants` are words with blanks between them; `plants` is NULL where all of the organisation's are meant. After a
-- rotation the previous secret goes on until its time.
CREATE TABLE api_keys (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
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
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
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
