"""Images read at surface points: one reader, one visibility, one policy for grazing views."""
