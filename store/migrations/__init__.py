"""The steps from the tables of one version of Fewview to those of the next, run by Alembic."""
