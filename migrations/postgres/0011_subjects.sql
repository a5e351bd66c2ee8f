-- Who did it, where that was shown by a token of an identity provider and not by a key.
ALTER TABLE audit ADD COLUMN subject TEXT;
