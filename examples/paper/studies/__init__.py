"""The studies: what is measured for each table and figure."""
