//! A dashboard over run directories that the tests make, asked over HTTP and shown in a real browser.

#![allow(clippy::unwrap_used)]

mod api;
mod browser;
mod fixture;
