-- A survey's uploads are listed in the order of their identifiers.
CREATE INDEX uploads_of_survey ON uploads (survey_id, id);
