-- Requests that clients named, so that they may send them again; `status` and what stands beside it is NULL until one is
-- answered.
CREATE TABLE requests (
    organisation_id TEXT NOT NULL REFERENCES organisations (id) ON DELETE CASCADE,
    name TEXT NOT NULL,
    fingerprint TEXT,
    status BIGINT,
    headers TEXT,
    body BLOB,
    expires_ms BIGINT NOT NULL,
    PRIMARY KEY (organisation_id, name)
);

CREATE INDEX requests_by_expiry ON requests (expires_ms);
