"""Publish a data set: a folder and a zip with metadata in several standards, checked by validators.

contents             write the published data set: shifted times, plain columns, nothing private
description          describe the package once, for all metadata files and texts
tables               write the CSV tables beside the data, the checksums and the zip
croissant, metadata  write the metadata files
checking             validate a package
package              publish: all of these steps in order
"""
