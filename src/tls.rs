//! The cryptography under TLS: one for all clients of this process.

/// Makes ring the process's TLS provider, unless it has one. Whoever makes a client calls this before.
pub fn provide() {
    // The only error is that there is one already.
    let _ = rustls::crypto::ring::default_provider().install_default();
}
