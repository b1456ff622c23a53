"""Publishing a data set: a folder and a zip with metadata in several standards, checked by validators.

contents      the published data set: shifted times, plain columns, nothing private
description   one description of the package, the source of all metadata
tables        the CSV tables beside the data, checksums and the zip
croissant, metadata, bids, readme   the metadata files and texts
checking      the validators
package       all of it in order
"""
