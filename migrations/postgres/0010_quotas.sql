-- What an organisation may keep. NULL stands for what the service's configuration says.
ALTER TABLE organisations ADD COLUMN max_bytes BIGINT;
ALTER TABLE organisations ADD COLUMN max_plants BIGINT;

-- The bytes that a plant keeps, each counted once however many files hold them; `plants.bytes` is their sum, which changes in
-- the same transaction.
CREATE TABLE blobs (
    plant_id TEXT NOT NULL REFERENCES plants (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL,
    size BIGINT NOT NULL,
    PRIMARY KEY (plant_id, sha256)
);

INSERT INTO blobs (plant_id, sha256, size)
SELECT plant_id, sha256, MAX(size) FROM (
    SELECT surveys.plant_id, files.sha256, files.size FROM files JOIN surveys ON surveys.id = files.survey_id
    UNION ALL
    SELECT plant_id, sha256, size FROM models
) AS kept GROUP BY plant_id, sha256;

ALTER TABLE plants ADD COLUMN bytes BIGINT NOT NULL DEFAULT 0;
UPDATE plants SET bytes = COALESCE((SELECT SUM(size) FROM blobs WHERE blobs.plant_id = plants.id), 0);
