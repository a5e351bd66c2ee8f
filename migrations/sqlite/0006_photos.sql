-- What was found in a file, JSON: in a photo, camera, time, position and how good it is; in a reconstruction, the names of
-- the images that it was made from.
ALTER TABLE files ADD COLUMN photo TEXT;
ALTER TABLE files ADD COLUMN shots TEXT;

CREATE INDEX files_by_digest ON files (survey_id, sha256);
