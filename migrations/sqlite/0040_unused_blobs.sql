-- A blob is deleted once no file and no model has named it for a while. `unused_ms` is since when none does, or when it was last
-- reserved for a file to come; NULL where one does. `freeing_ms` is when somebody set out to delete its bytes: until they are
-- gone, and the row with them, nobody may name it.
ALTER TABLE blobs ADD COLUMN unused_ms BIGINT;
ALTER TABLE blobs ADD COLUMN freeing_ms BIGINT;

UPDATE blobs SET unused_ms = CAST(strftime('%s', 'now') AS INTEGER) * 1000
WHERE NOT EXISTS (SELECT 1 FROM files JOIN surveys ON surveys.id = files.survey_id
    WHERE surveys.plant_id = blobs.plant_id AND files.sha256 = blobs.sha256)
AND NOT EXISTS (SELECT 1 FROM models WHERE models.plant_id = blobs.plant_id AND models.sha256 = blobs.sha256);

CREATE INDEX blobs_unused ON blobs (unused_ms) WHERE unused_ms IS NOT NULL;
