"""The WCS of an exposure: gwcs, its ASDF file, FITS headers with SIP or TPV, and frames that both go into."""
