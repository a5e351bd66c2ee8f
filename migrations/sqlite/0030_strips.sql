-- A layer may be as wide as it is tall: features are found by the strip of longitudes in which they begin, then by latitude.
-- The largest extent west to east of one feature bounds how many strips before a box are looked at.
ALTER TABLE layers ADD COLUMN widest_deg DOUBLE PRECISION NOT NULL DEFAULT 0;
UPDATE layers SET widest_deg = COALESCE((SELECT MAX(max_lon - min_lon) FROM features
    WHERE features.model_seq = layers.model_seq AND features.layer = layers.layer), 0);
ALTER TABLE features ADD COLUMN strip BIGINT;
UPDATE features SET strip = CAST((min_lon + 180.0) / 0.0005 AS INTEGER);
DROP INDEX features_by_place;
CREATE INDEX features_by_place ON features (model_seq, layer, strip, min_lat, max_lat, min_lon, max_lon, seq);
