"""Errors of single poses: VSS, VSD, MSSD, MSPD, ADD, ADI, rotation, translation."""
