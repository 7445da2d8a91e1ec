"""Board after board: tap after tap, by a sheet, or every node of a bus at once."""
