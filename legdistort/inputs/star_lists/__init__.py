"""Star lists of other programs: tables of many formats, columns of many names."""
