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
