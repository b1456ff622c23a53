"""Publish a data set: a folder and a zip with metadata in several standards, checked by validators.

contents             the published data set: shifted times, plain columns, nothing private
description          one description of the package, the source of all metadata, and its texts
tables               the CSV tables beside the data, checksums and the zip
croissant, metadata  the metadata files
checking             the validators
package              all of it in order
"""
