-- A key's scopes and plants are JSON arrays instead of words with blanks between them. Columns are renamed where the meaning
-- changes, so that a process of an older version that still runs fails instead of misreading them. For the same reason the
-- columns of a job that its worker reads and writes are renamed: an older worker can neither claim nor complete a job here.
ALTER TABLE api_keys RENAME COLUMN scopes TO scopes_json;
UPDATE api_keys SET scopes_json = CAST(to_json(string_to_array(scopes_json, ' ')) AS TEXT);
ALTER TABLE api_keys RENAME COLUMN plants TO plants_json;
UPDATE api_keys SET plants_json = CAST(to_json(string_to_array(plants_json, ' ')) AS TEXT) WHERE plants_json IS NOT NULL;

ALTER TABLE jobs RENAME COLUMN options TO options_json;
ALTER TABLE jobs RENAME COLUMN lease_until_ms TO claim_expires_ms;
