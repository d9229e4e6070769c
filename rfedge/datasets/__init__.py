"""Datasets made of what users own: conversion, poses by structure from motion, CARLA recording."""
