-- Who ends an upload whose bytes are all there, and until when nobody else does.
ALTER TABLE uploads ADD COLUMN ender TEXT;
ALTER TABLE uploads ADD COLUMN ending_until_ms BIGINT NOT NULL DEFAULT 0;

-- Pieces in the bucket that count: whose data folder has the bytes as well, and all before them.
CREATE TABLE upload_pieces (
    upload_id TEXT NOT NULL REFERENCES uploads (id) ON DELETE CASCADE,
    begins BIGINT NOT NULL,
    ends BIGINT NOT NULL,
    name TEXT NOT NULL,
    home TEXT NOT NULL,
    PRIMARY KEY (upload_id, begins)
);
