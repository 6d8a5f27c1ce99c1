"""From a file to what is wrong with it: reading with places, checking, telling in plain words."""
