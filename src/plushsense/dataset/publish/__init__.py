"""Publishing a data set: a folder and a zip that strangers can find, open, trust and cite, proved by validators.

shifting      times that say nothing about the day
contents      what leaves: recordings, streams, tables, and nothing else
description   one description of the package, from which all metadata are written
as_croissant, as_crate, as_datapackage, as_datacite, as_bids, readme
agreement     whether a package agrees with itself
archive       checksums and the zip
checking      the validators
package       all of it in order
"""
